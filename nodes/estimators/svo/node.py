"""SVO as a node: the images it reads, and the estimates it sends."""

from __future__ import annotations

from nodes.estimators import WORKER_ENVIRONMENT, Estimator, EstimatorConfig, MonocularFrame
from nodes.estimators.svo.process import INSTALL, SvoProcess
from nodes.estimators.svo.settings import SvoSettings
from runtime import Bundle


class SvoConfig(EstimatorConfig):
    """Settings of SVO.

    Attributes:
        svo: SVO's own settings.
    """

    svo: SvoSettings = SvoSettings()


class Svo(Estimator[SvoConfig]):
    """Estimates the pose of a single camera by SVO, in a process and a unit of length of its own.

    C. Forster, M. Pizzoli and D. Scaramuzza, "SVO: Fast Semi-Direct Monocular Visual Odometry",
    ICRA 2014.
    """

    needs = frozenset({"grey"})
    lenses = frozenset()
    method = "SVO"
    library = "svo_cpp", INSTALL
    scale_free = True

    frames = Bundle(MonocularFrame, keep="latest")

    async def on_ready(self) -> None:
        """Start SVO, in a process of its own."""
        self._svo = await self.worker(
            SvoProcess,
            self.the_camera().info,
            self.config.svo,
            latency=self.config.latency,
            env=WORKER_ENVIRONMENT,
        )

    async def run(self) -> None:
        """Track each image; nothing is sent until there is a map."""
        async for (image,) in self.frames:
            stamp = self.exposed_at(image)
            result = await self._svo.call(SvoProcess.track, stamp, image.data)
            if result is not None:
                self.publish(image, result)
