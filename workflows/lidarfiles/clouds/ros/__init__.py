"""ROS 2 point layouts, messages and bags."""
