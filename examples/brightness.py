"""A node of one's own: it tells how bright is what a camera sees."""

from __future__ import annotations

import numpy as np

from events import Image, Score
from runtime import Input, Node, Output


class Brightness(Node):
    """Scores the mean brightness of each image."""

    images = Input(Image, keep="latest")
    scores = Output(Score)

    async def run(self) -> None:
        """Score what comes, beside the loop; images that come meanwhile are skipped."""
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
