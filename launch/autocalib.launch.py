"""One camera's node in the namespace of the camera.

    ros2 launch autocalib_ros autocalib.launch.py namespace:=cam1 image:=image_raw camera_height:=8.0

Every argument may be left out; what it then means stands in ARGUMENTS.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = (
    ('namespace', '', 'namespace of the camera; it also names the frames, cam1_ground for cam1'),
    ('image', 'image_raw', 'image topic, relative to the namespace or absolute'),
    ('camera_height', '', 'height of the camera above the road, metres; empty leaves it to params_file'),
    ('params_file', '', 'file with options, as config/autocalib.yaml documents them; empty takes the defaults'),
    (
        'camera_info',
        '',
        'where camera_info goes, `camera_info` say when the driver publishes none; '
        'empty is <namespace>/autocalib/camera_info',
    ),
)


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node with those that were given."""
    walk_options = [
        DeclareLaunchArgument(name, default_value=default, description=text) for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*walk_options, OpaqueFunction(function=start_node)])


def start_node(context: LaunchContext) -> list[Node]:
    """Return the node; what is empty is left out, so that a file's value is not overridden by a default."""
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    parameters: list[str | dict[str, float]] = [given['params_file']] if given['params_file'] else []
    if given['camera_height']:
        parameters.append({'camera_height': float(given['camera_height'])})
    remappings = [('image', given['image'])]
    if given['camera_info']:
        remappings.append(('~/camera_info', given['camera_info']))
    return [
        Node(
            package='autocalib_ros',
            executable='autocalib_node',
            name='autocalib',
            namespace=given['namespace'],
            output='screen',
            parameters=parameters,
            remappings=remappings,
        )
    ]
