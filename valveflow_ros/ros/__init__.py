"""The only folder that knows ROS: node, replay, simulated plant, conversions."""
