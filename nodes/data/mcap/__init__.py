"""MCAP files, for the recorder and for replays: ROS 2 messages, and events as they are.

Read in this order: `mcap_file` (writes and reads files), `layout` and `records` (what stands in
them, sound or not; `records` has the only import of mcap), `disk` (writes whole pieces), `native`
(messages that hold an event as it is, and the arrays that such a message lacks).
"""
