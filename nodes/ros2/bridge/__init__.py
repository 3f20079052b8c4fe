"""ROS 2 over Zenoh, as rmw_zenoh_cpp uses it; no ROS needs to be installed here.

Read in this order: `settings`, `keys` and `attachment` (how a topic is named on Zenoh),
`publisher`, `session` (the only import of zenoh), `incoming_topic` (from messages to events) and
`outgoing_topic` (by mappings of the user's own, which `mappings` imports), `inbox` and `complaints`
(messages from outside must not hurt the run), `held` (who owes answers), `service_server`
and `services` (what ROS may ask for), `node`. What a message of ROS is, is for
`nodes.ros2.messages`.
"""

from nodes.ros2.bridge.node import Ros2Bridge

__all__ = ["Ros2Bridge"]
