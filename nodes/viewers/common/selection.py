"""Which images and which plan are shown."""

from __future__ import annotations

from collections import deque

from events import PlannedPose, PositionSetpoint
from runtime.time.schedule import SECOND

REMEMBERED = 64
"""Images of a camera whose features may still come."""


class ImageSelection:
    """Selects images by their stamps, so that of one exposure all are shown or none.

    Args:
        rate: Images a second at most; 0: none.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._last: dict[tuple[str, str], int] = {}
        self._selected: dict[str, deque[int]] = {}

    def select(self, kind: str, source: str, frame_id: str, stamp: int) -> bool:
        """Tell whether an image is shown: it is the first of its source in its period.

        Args:
            kind: Of image; each kind of a source is selected for itself.
            source: Of the image.
            frame_id: Of its camera.
            stamp: Of its exposure (ns).
        """
        if not self._rate:
            return False
        period = int(stamp * self._rate // SECOND)
        if self._last.get((kind, source)) == period:
            return False
        self._last[kind, source] = period
        self._selected.setdefault(frame_id, deque(maxlen=REMEMBERED)).append(stamp)
        return True

    def selected(self, frame_id: str, stamp: int) -> bool:
        """Tell whether an image of this camera and exposure is shown."""
        return stamp in self._selected.get(frame_id, ())


class PlanSelection:
    """Selects what is drawn as a vehicle's plan: planned poses, or set-points if there are none."""

    def __init__(self) -> None:
        self._kinds: dict[str, type[PlannedPose | PositionSetpoint]] = {}

    def select(self, event: PlannedPose | PositionSetpoint) -> bool:
        """Tell whether an event is part of the plan."""
        if self._kinds.get(event.vehicle) is not PlannedPose:
            self._kinds[event.vehicle] = type(event)
        return isinstance(event, self._kinds[event.vehicle])
