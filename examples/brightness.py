"""Example of a node: measures the brightness of a camera's images."""

from __future__ import annotations

import numpy as np

from events import Image, Score
from runtime import Input, Node, Output


class Brightness(Node):
    """Scores the mean brightness of each image."""

    images = Input(Image, keep="latest")
    scores = Output(Score)

    async def run(self) -> None:
        """Score images beside the loop; skip images arriving meanwhile."""
        async for image in self.images:
            mean = await self.offload(np.mean, image.data)
            self.scores.send(
                Score(
                    stamp=image.stamp,
                    source=self.name,
                    subject=image.source,
                    metric="brightness",
                    value=float(mean),
                    unit="grey levels",
                )
            )
