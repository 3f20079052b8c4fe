"""ROS 2 over Zenoh, as rmw_zenoh_cpp speaks it; no ROS needs to be installed here.

Read in this order: `settings` (what the file says), `plan` (which topics there will be), `keys`,
`gid` and `attachment` (how a topic is named on Zenoh), `typestore` (message types and CDR; the
only import of rosbags), `frames` (NED and FRD to ENU and FLU), `messages` and `pictures` (events to
messages), `incoming` (and back), `session` (the only import of zenoh), `inbox` and `complaints`
(what comes from outside must not hurt the run), `node`.
"""

from nodes.ros2_bridge.node import Ros2Bridge

__all__ = ["Ros2Bridge"]
