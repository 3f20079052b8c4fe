"""ROS 2 messages from and to events: pure conversion, without nodes, network or ROS."""
