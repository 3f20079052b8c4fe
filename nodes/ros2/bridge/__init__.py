"""ROS 2 over Zenoh, compatible with rmw_zenoh_cpp; no installation of ROS needed.

Read in this order: `settings`, `keys` (how topics are named on Zenoh, and what goes with messages),
`session` (the only import of zenoh), `incoming_topic` (between messages and events, by settings of
the user's), `held` (estimators that owe answers), `services` (what ROS may ask for), `node`. What a
message of ROS is, is for `nodes.ros2.messages`.
"""

from nodes.ros2.bridge.node import Ros2Bridge

__all__ = ["Ros2Bridge"]
