"""Messages of ROS 2 as they are stored: files of them, their definitions, and the numbers in them."""
