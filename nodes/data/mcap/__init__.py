"""MCAP files, for the recorder and for replays: ROS 2 messages, and events as they are."""
