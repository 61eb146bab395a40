"""The live shell: the only rooms that import rclpy and message packages."""
