"""Read rosbag2, ROS 1 bags, MCAP files and videos as sources of images; write rosbag2 recordings."""
