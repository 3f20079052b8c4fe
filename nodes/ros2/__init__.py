"""ROS 2 messages, and a bridge for a run as a ROS 2 node."""
