"""ROS 2 nodes: thin wiring of the core. The only place, with messages.py, that knows ROS."""
