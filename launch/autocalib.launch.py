"""Start the node of one camera in the namespace of the camera.

    ros2 launch autocalib_ros autocalib.launch.py namespace:=cam1 image:=image_raw camera_height:=8.0

All arguments are optional; ARGUMENTS gives their defaults.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = (
    ('namespace', '', 'namespace of the camera; also the prefix of its frames, cam1_ground for cam1'),
    ('image', 'image_raw', 'image topic, relative to the namespace or absolute'),
    ('camera_height', '', 'height of the camera above the road, metres; empty: from params_file'),
    ('params_file', '', 'parameter file in the format of config/autocalib.yaml; empty: the defaults'),
    (
        'camera_info',
        '',
        'topic to publish CameraInfo on, such as camera_info if the driver publishes none; '
        'empty: <namespace>/autocalib/camera_info',
    ),
)


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node with those that were given."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text) for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_node)])


def start_node(context: LaunchContext) -> list[Node]:
    """Return the node; empty arguments are not passed on, so that they do not override values of params_file."""
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
