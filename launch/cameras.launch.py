"""Start the nodes of many cameras, one process each, from a file with a list of cameras.

    ros2 launch autocalib_ros cameras.launch.py cameras:=cameras.yaml

config/cameras.yaml is an example; autocalib_ros/ros/cameras.py documents the format.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from autocalib_ros.ros.cameras import NODE_NAME, read_cameras


def generate_launch_description() -> LaunchDescription:
    """Declare the argument and start the nodes that the file describes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('cameras', description='YAML file with the list of cameras'),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context: LaunchContext) -> list[Node]:
    """Return a node for each camera of the file."""
    return [
        Node(
            package='autocalib_ros',
            executable='autocalib_node',
            name=NODE_NAME,
            namespace=camera.namespace,
            output='screen',
            parameters=list(camera.parameters),
            remappings=list(camera.remappings),
        )
        for camera in read_cameras(LaunchConfiguration('cameras').perform(context))
    ]
