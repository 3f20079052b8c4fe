"""A node that trains ORB-SLAM3's vocabulary from the images of a run, and writes it at the end.

``python -m runtime vocabulary CONFIG`` runs it in place of the ORB-SLAM3 nodes of a file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np

from events import Image
from nodes.estimators.orb_slam3.vocabulary import Bytes, TreeShape, train
from nodes.estimators.orb_slam3.vocabulary_file import cached_vocabulary, write_vocabulary
from runtime import Input, Node, NodeConfig


class VocabularyTrainerConfig(NodeConfig):
    """Settings of the training.

    Attributes:
        path: File to write; if empty, the one that ORB-SLAM3 nodes read by default.
        image_interval: One of this many images of each camera is used.
        features: Corners described in an image, at most.
        shape: Shape of the vocabulary's tree.
    """

    path: str = ""
    image_interval: Annotated[int, msgspec.Meta(ge=1)] = 15
    features: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 1000
    shape: TreeShape = TreeShape()

    def file(self) -> Path:
        """Return the file to write."""
        return Path(self.path).expanduser() if self.path else cached_vocabulary(self.shape)


class VocabularyTrainer(Node[VocabularyTrainerConfig]):
    """Describes the images of all cameras, and trains a vocabulary from them at the end."""

    images = Input(Image, keep="latest")

    def __init__(self) -> None:
        self._descriptors: list[Bytes] = []

    async def run(self) -> None:
        """Describe one of every `image_interval` images."""
        seen: dict[str, int] = {}
        async for image in self.images:
            count = seen[image.source] = seen.get(image.source, -1) + 1
            if count % self.config.image_interval == 0:
                found = await self.offload(describe, image.data, self.config.features)
                self._descriptors.append(found)

    async def on_shutdown(self) -> None:
        """Train, and write the file."""
        vocabulary = await self.offload(train, self._descriptors, self.config.shape)
        await self.offload(write_vocabulary, vocabulary, self.config.file())
        self.log.info(
            "%d words from %d corners in %d images",
            vocabulary.leaves.sum(),
            sum(map(len, self._descriptors)),
            len(self._descriptors),
        )


def describe(image: Bytes, features: int) -> Bytes:
    """Return the ORB descriptors of an image's corners, uint8 (n, 32).

    Args:
        image: Shape (h, w, 3) red, green, blue, or (h, w) grey.
        features: Number of corners, at most.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # 7 grey levels: what ORB-SLAM3 goes down to where there is little to see.
    orb = cv2.ORB.create(nfeatures=features, fastThreshold=7)
    descriptors: Any = orb.detectAndCompute(grey, None)[1]
    return np.empty((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors)
