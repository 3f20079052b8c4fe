"""Which of several vehicles a source of events belongs to."""

from __future__ import annotations

from events import (
    Announcement,
    CameraAnnouncement,
    EstimatorAnnouncement,
    TrackedFeatures,
    VehicleAnnouncement,
)


class Vehicles:
    """The vehicles of a run, and what belongs to each.

    A source belongs to the vehicle whose name it equals or begins with: ``drone/camera`` to
    ``drone``. An estimator, whose name says nothing, belongs to the vehicle that it announces, or
    that carries the camera in whose images it tracks features; what says nothing at all belongs to
    the first vehicle.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        """Of the vehicles, in the order in which they were announced."""
        self._cameras: dict[str, str] = {}
        """Optical frame to source."""
        self._followed: dict[str, str] = {}
        """Estimator to the optical frame of its camera."""
        self._estimated: dict[str, str] = {}
        """Estimator to the vehicle that it announces."""

    def announced(self, announcement: Announcement) -> None:
        """Note a vehicle, a camera or an estimator."""
        if isinstance(announcement, VehicleAnnouncement):
            self.add(announcement.source)
        elif isinstance(announcement, CameraAnnouncement):
            self._cameras.setdefault(announcement.frame_id, announcement.source)
        elif isinstance(announcement, EstimatorAnnouncement):
            self._estimated[announcement.source] = announcement.vehicle

    def add(self, name: str) -> None:
        """Note a vehicle."""
        if name not in self.names:
            self.names.append(name)

    def tracked(self, event: TrackedFeatures) -> None:
        """Note whose images an estimator looks at."""
        self._followed[event.source] = event.frame_id

    def carrier(self, source: str) -> str:
        """Return the vehicle that a source names; empty if it names none."""
        found = (v for v in self.names if source == v or source.startswith(f"{v}/"))
        return next(found, "")

    def of(self, source: str) -> str:
        """Return the vehicle that a source belongs to; empty if there are no vehicles."""
        camera = self._cameras.get(self._followed.get(source, ""), "")
        said = self._estimated.get(source, "") or self.carrier(source)
        return said or self.carrier(camera) or next(iter(self.names), "")
