"""The command `valveflow`. Nothing heavy is imported before a verb needs it, and ROS never."""
