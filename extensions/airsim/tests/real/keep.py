"""A node that keeps the run's own images, to compare a client's with them."""

from __future__ import annotations

import numpy as np

from events import DepthImage, Image, SegmentationImage
from runtime import Node, on


class Keep(Node):
    """Writes each image as ``KIND-STAMP.npy`` into the run's folder."""

    @on(Image, DepthImage, SegmentationImage)
    def images(self, event: Image | DepthImage | SegmentationImage) -> None:
        """Write an image."""
        assert self.out is not None
        np.save(self.out / f"{type(event).__name__}-{event.stamp}.npy", event.data)
