"""The monitor: rows in, events out, without a clock, files, threads or ROS."""
