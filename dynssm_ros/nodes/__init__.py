"""rclpy nodes: thin shells that convert messages, call a ROS-free core, and publish. The only room that imports rclpy."""

import os

# as in the command line: threads of numpy's BLAS wait for each other longer than they compute
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
