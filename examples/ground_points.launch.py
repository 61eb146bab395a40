"""A camera's calibration, and a node that converts pixels to points on the road.

Start it: ros2 launch examples/ground_points.launch.py namespace:=cam1 camera_height:=8.0 pixels:=wheels
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = (
    ('namespace', 'cam1', 'namespace of the camera'),
    ('image', 'image_raw', 'image topic, relative to the namespace or absolute'),
    ('camera_height', '8.0', 'height of the camera above the road, metres'),
    ('pixels', 'wheels', 'geometry_msgs/PolygonStamped with the pixels, relative to the namespace or absolute'),
)


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start both nodes."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text) for name, default, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])


def start_nodes(context: LaunchContext) -> list[Node]:
    """Return the calibration node and the one that uses its result."""
    namespace, image, height, pixels = (LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS)
    # beside the topics of the calibration node, where config/autocalib.rviz expects ground_points
    pixels = pixels if pixels.startswith('/') else f'/{namespace}/{pixels}'
    return [
        Node(
            package='autocalib_ros',
            executable='autocalib_node',
            name='autocalib',
            namespace=namespace,
            output='screen',
            parameters=[{'camera_height': float(height)}],
            remappings=[('image', image)],
        ),
        Node(
            package='autocalib_ros',
            executable='ground_points_node',
            name='ground_points',
            namespace=f'{namespace}/autocalib',
            output='screen',
            remappings=[('pixels', pixels)],
        ),
    ]
