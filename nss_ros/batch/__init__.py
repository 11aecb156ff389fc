"""Methods over a whole dataset, without a ROS graph: pairs, maps and the logs that are scored."""
