"""Base of the odometries: a node around a tracker in a process of its own."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

from events import DepthImage, Image
from nodes.estimators.estimator import C, Estimator
from nodes.estimators.rig import TrackingResult, sample_rows
from runtime import Bundle


class Tracker(Protocol):
    """Tracker of an odometry."""

    def track(self, stamp: int, *data: Any) -> TrackingResult | None:
        """Return the pose of the next frame; `None` before there is a map.

        Args:
            stamp: Of the exposure on the clock of the IMU (ns).
            data: Of each field of the frame: an image, shape (h, w, 3) red, green, blue, or (h, w)
                grey; depth, metres along the optical axis, shape (h, w), ``inf`` where nothing was
                measured; samples of the IMU since the frame before, as of `sample_rows`.

        Raises:
            ValueError: The size is not that of the camera.
        """


class OdometryNode(Estimator[C]):
    """Base of nodes around a tracker, in a process of its own."""

    frames: Bundle[Any]
    tracks: Callable[..., TrackingResult | None] = staticmethod(Tracker.track)
    """Method of the tracker that takes a frame; its arguments are those of `Tracker.track`."""

    @abstractmethod
    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker, and its arguments."""

    async def on_ready(self) -> None:
        """Start the tracker."""
        self._tracker = await self.start_tracker(*self.tracker())

    async def run(self) -> None:
        """Track each frame; those arriving meanwhile are skipped, samples of the IMU are not."""
        async for frame in self.frames:
            image = frame[0]
            data = [
                part.data if isinstance(part, Image | DepthImage) else sample_rows(part)
                for part in frame
            ]
            result = await self._tracker.call(self.tracks, self.exposed_at(image), *data)
            if result is not None:  # there is a map
                self.publish(image, result)
