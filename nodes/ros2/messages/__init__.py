"""ROS 2 messages: events become messages here, and messages become events.

Pure conversion: no node, no asyncio, no network, and no ROS needs to be installed. The ROS 2
bridge, the MCAP recorder, replays and benchmarks use it.

Read in this order: `topics` (names, types, quality of service), `typestore` (message types and
CDR; the only import of rosbags), `frames` and `frame_names` (NED and FRD to ENU and FLU, and what
ROS calls a frame), `stamps`, `messages`, `images`, `depth`, `paths` and `transforms` (events to
messages), `incoming` and `calibration` (messages to events).
"""
