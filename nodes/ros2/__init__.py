"""ROS 2: its messages, and a bridge that makes a run a node of it."""
