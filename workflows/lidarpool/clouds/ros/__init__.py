"""Messages of ROS 2: layouts of points, messages of a survey, and bags."""
