"""rclpy nodes: thin shells that convert messages, call a ROS-free core, and publish. The only room that imports rclpy."""
