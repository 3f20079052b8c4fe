"""ROS 2 over Zenoh, compatible with rmw_zenoh_cpp; no installation of ROS needed."""

from nodes.ros2.bridge.node import Ros2Bridge

__all__ = ["Ros2Bridge"]
