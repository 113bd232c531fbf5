"""ROS messages <-> named SI signals on a time grid: signal maps, bags, resampling, recordings, the live window."""
