"""Which of the announced sensors an estimator reads: one camera or a stereo rig, and an IMU."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

from events import Announcement, CameraAnnouncement, ImuAnnouncement
from runtime.errors import suggest


class SensorChoice:
    """Chooses among what is announced, as far as it is known.

    Args:
        needs: Kinds of image that each camera must give.
        eyes: Number of cameras, 1 or 2.
        inertial: Whether an IMU is needed.
        named: Port to the source that the file names for it: ``frames`` or ``frames.left`` (the
            first camera), ``frames.right``, ``frames.imu``.
        refusals: Returns why images of one or both eyes are of no use, a sentence by each source;
            empty if they are. Called with False, as they are, and with True, as they can be
            rectified.

    Attributes:
        cameras: The chosen ones, the left one first; empty while there are none. Those whose
            images are of use as they are come before those that have to be rectified.
        rectified: Whether their images have to be.
        imu: The chosen IMU, on the vehicle of the first camera; `None` while there is none.
    """

    def __init__(
        self,
        needs: Collection[str],
        eyes: int,
        inertial: bool,
        named: Mapping[str, str],
        refusals: Callable[[Sequence[CameraAnnouncement], bool], Mapping[str, str]],
    ) -> None:
        self.cameras: tuple[CameraAnnouncement, ...] = ()
        self.rectified = False
        self.imu: ImuAnnouncement | None = None
        self._needs, self._eyes, self._inertial = frozenset(needs), eyes, inertial
        self._first = named.get("frames.left", named.get("frames"))
        self._second = named.get("frames.right")
        self._imu = named.get("frames.imu")
        self._refused = refusals
        self._seen: list[CameraAnnouncement] = []
        self._imus: list[ImuAnnouncement] = []
        self._refusals: dict[str, str] = {}

    def announced(self, announcement: Announcement) -> None:
        """Take note of a camera or an IMU, and choose if that is possible now."""
        if isinstance(announcement, CameraAnnouncement):
            self._seen.append(announcement)
            if not self.cameras or self.rectified:
                self._choose_cameras()
        elif isinstance(announcement, ImuAnnouncement):
            self._imus.append(announcement)
        if self._inertial and self.imu is None and self.cameras:
            body = self.cameras[0].source.rpartition("/")[0]
            self.imu = next((imu for imu in self._imus if self._fits(imu, body)), None)

    def missing(self) -> str:
        """Return what is not there, in a sentence; empty if nothing is missing."""
        if not self.cameras:
            return self._no_camera()
        if self._inertial and self.imu is None:
            found = ", ".join(imu.source for imu in self._imus) or "none"
            return f"expected an IMU beside {self.cameras[0].source}, found {found}"
        return ""

    def _fits(self, imu: ImuAnnouncement, body: str) -> bool:
        return imu.source == self._imu or (
            self._imu is None and imu.source.rpartition("/")[0] == body
        )

    def _choose_cameras(self) -> None:
        """Choose the first whose images are of use, for the first time or in place of rectified."""
        sets = list(self._candidates())
        for rectified in (False, True)[: 1 if self.cameras else 2]:
            for cameras in sets:
                found = self._refused(cameras, rectified)
                if not found:
                    self.cameras, self.rectified, self.imu = cameras, rectified, None
                    return
                self._refusals |= found

    def _candidates(self) -> Iterator[tuple[CameraAnnouncement, ...]]:
        """Yield cameras (or pairs) that give all kinds of image."""
        for camera in self._seen:
            right_eye = camera.stereo and camera.source != self._first
            if right_eye or not self._gives_all(camera, self._first):
                continue
            if self._eyes == 1:
                yield (camera,)
                continue
            right = next((c for c in self._seen if self._is_partner(c, camera)), None)
            if right is not None and self._gives_all(right, right.source):
                yield camera, right

    def _is_partner(self, camera: CameraAnnouncement, left: CameraAnnouncement) -> bool:
        if self._second is not None:
            return camera.source == self._second
        return camera.stereo == left.source

    def _gives_all(self, camera: CameraAnnouncement, named: str | None) -> bool:
        """Tell whether a camera may be chosen and gives all kinds of image.

        Raises:
            ValueError: It is the one that the file names, and lacks a kind of image.
        """
        if named is not None and camera.source != named:
            return False
        lacking = self._needs - given(camera)
        if lacking and named is not None:
            raise ValueError(
                f"expected a camera with {', '.join(sorted(self._needs))} images, "
                f"found none with {', '.join(sorted(lacking))}"
            )
        return not lacking

    def _no_camera(self) -> str:
        if self._refusals:
            return "; ".join(f"{source}: {why}" for source, why in self._refusals.items())
        sources = [camera.source for camera in self._seen]
        called = f" called {self._first}" if self._first else ""
        what = "camera" if self._eyes == 1 else "stereo rig"
        return (
            f"expected a {what} with {', '.join(sorted(self._needs))} images{called}, "
            f"found {', '.join(sources) or 'none'}{suggest(self._first or '', sources)}"
        )


def given(camera: CameraAnnouncement) -> set[str]:
    """Return the kinds of image that a camera gives; ``rgb`` serves for ``grey``, too."""
    return {*camera.images} | ({"grey"} if "rgb" in camera.images else set())
