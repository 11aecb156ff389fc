"""One map of a building that changes: multi-stage point cloud registration for ROS 2."""

__version__ = "0.1.0"
