"""``vocabulary``: training of ORB-SLAM3's vocabulary from a run's images, by a node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import typer

from events import Image
from runtime import Input, Node, NodeConfig
from runtime.tools.cli.commands import ConfigFile, Overrides
from visnav_estimators.orb_slam3.settings import (
    Bytes,
    TreeShape,
    cached_vocabulary,
    train,
    write_vocabulary,
)


class VocabularyTrainerConfig(NodeConfig):
    """Settings of the training.

    Attributes:
        path: File to write; if empty, the one that ORB-SLAM3 nodes read by default.
        image_interval: Uses one of this many images of each camera.
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
        """Describe every `image_interval`-th image."""
        counts: dict[str, int] = {}
        async for image in self.images:
            count = counts[image.source] = counts.get(image.source, -1) + 1
            if count % self.config.image_interval == 0:
                descriptors = await self.offload(describe, image.data, self.config.features)
                self._descriptors.append(descriptors)

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
    """Return the ORB descriptors, uint8 (n, 32), of up to `features` corners of an image."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # 7 grey levels: what ORB-SLAM3 goes down to where there is little to see.
    orb = cv2.ORB.create(nfeatures=features, fastThreshold=7)
    descriptors: Any = orb.detectAndCompute(grey, None)[1]
    return np.empty((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors)


_SHUTDOWN_LIMIT = 300.0  # seconds; the training is done as the node shuts down


def vocabulary(
    config: ConfigFile,
    out: Annotated[
        Path | None,
        typer.Option(help="File to write; where ORB-SLAM3 nodes look by themselves if not given."),
    ] = None,
    overrides: Overrides = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> None:
    """Train ORB-SLAM3's vocabulary from the images of a file's cameras.

    Runs the file without its ORB-SLAM3 nodes and results; these nodes then find the vocabulary by
    themselves. It serves best in its own world.
    """
    import msgspec
    from rich.console import Console

    from runtime.config.model import Config, NodeSpec
    from runtime.config.reading import load_configuration
    from runtime.errors import ConfigError
    from runtime.logs import terminal_handler
    from runtime.run.execute import execute
    from runtime.tools.cli.brief import progress
    from runtime.tools.cli.run import leave_behind
    from runtime.units import Duration
    from visnav_estimators.orb_slam3.node import OrbSlam3

    if out is not None and out.suffix != ".txt":  # ORB-SLAM3 would read it as binary
        raise ConfigError(f"--out: expected a name that ends with .txt, found {out}")
    settings = load_configuration(config, overrides or [])
    options = VocabularyTrainerConfig(path="" if out is None else str(out.resolve()))
    spec = NodeSpec(
        name="vocabulary_trainer",
        type_name="VocabularyTrainer",
        on_error="stop",
        inputs={},
        links={},
        node=VocabularyTrainer,
        config=options,
    )
    others = (s for s in settings.nodes if not issubclass(s.node, OrbSlam3 | VocabularyTrainer))
    run = msgspec.structs.replace(
        settings.run, shutdown_limit=Duration(_SHUTDOWN_LIMIT), digest=False
    )
    console = Console(stderr=True)
    execute(
        Config(run=run, nodes=(*others, spec)),
        handlers=[terminal_handler(console)],
        watch=None if quiet else progress(run, console),
    )
    print(f"vocabulary: {options.file()}")
    if out is None:
        print("ORB-SLAM3 nodes find it there by themselves")
    else:
        print(f'for an ORB-SLAM3 node to use it: vocabulary = "{options.file()}"')
    leave_behind(0)
