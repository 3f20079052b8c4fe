"""A coloured cloud from the images of a camera with depth, put together by its true poses."""

from nodes.mapping.node import Mapping, MappingConfig

__all__ = ["Mapping", "MappingConfig"]
