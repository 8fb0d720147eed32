"""The engine: pure, without clock, files, threads or ROS."""
