"""Recordings: rosbag2, ROS 1 bags, mcap and videos as sources of images; writing of bags."""
