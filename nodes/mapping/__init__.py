"""A coloured cloud of what a camera with depth saw, put together by the true pose."""

from nodes.mapping.node import Mapping, MappingConfig

__all__ = ["Mapping", "MappingConfig"]
