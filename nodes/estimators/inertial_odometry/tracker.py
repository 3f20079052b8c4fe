"""Visual-inertial odometry: its nodes, the RGB-D tracker's map, and a filter driven by the IMU.

The IMU predicts the next image's pose, all landmarks found there correct the filter (tightly
coupled), and the map grows from the filter's pose. Where landmarks are few, a camera with depth is
aligned by edges and surfaces, too; a stereo rig's depth is too coarse there. Where nothing is seen,
the IMU alone carries the pose for a while; then the camera is lost, and without relocalization a
new map begins, in a frame of its own.
"""

from __future__ import annotations

from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, ImuAnnouncement
from events.covariance import cross_matrix
from events.geometry import inverse, pose_matrix
from nodes.estimators import EstimatorConfig, RgbdInertialFrame, StereoInertialFrame, TrackingResult
from nodes.estimators.images import Depth, Grey
from nodes.estimators.inertial_odometry.filter import POSE, G, InertialFilter, Sighting, V
from nodes.estimators.inertial_odometry.preintegration import Floats, ImuModel
from nodes.estimators.inertial_odometry.preintegration import Rows as ImageRows
from nodes.estimators.odometry import OdometryNode
from nodes.estimators.pose import rays, transform
from nodes.estimators.surfaces import Surfaces
from nodes.estimators.visual_odometry.alignment import Alignment
from nodes.estimators.visual_odometry.features import BELIEVED, FeatureSettings, FeatureTracker
from nodes.estimators.visual_odometry.landmarks import MapMatch, Rows
from nodes.estimators.visual_odometry.stereo import StereoMatcher, StereoSettings, baseline
from runtime import Bundle

_KNOWN = 0.3, 0.03  # largest deviations of velocity (m/s) and gravity (rad) to use the IMU
_READING = 0.8  # noise of a depth reading, relative to a single pixel's; errors of place included
_BENT = 0.003  # noise of depth on surfaces not quite planar, relative to inverse depth
_PLACED = 0.5, 0.5  # constant noise of a landmark's place, of a sighting's: pixel, depth
_COMMON, _COMMON_BY_EYES = (0.02, 0.0), (0.02, 0.1)
"""Shares common to all landmarks' variance in an image, of depth, of stereo: sightings, places."""
_MISALIGNED = 0.06  # what the correction of disparities leaves common to an image's, pixels
_MISFIT = 1.5  # largest median error of the landmarks, in standard deviations of a pixel
_PATIENCE, _DOUBTED = 0.4, 0.6  # averaging time (s), limit of contradicting share; then restart
_PREDICTED = np.diag(np.repeat([0.05**-2, 0.02**-2], 3))  # of the predicted pose: 5 cm, 0.02 rad
_SLOTS = (-1, -2)  # numbers of possible reference images of an alignment, beside the key frames'


class InertialSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the fusion with an IMU.

    Attributes:
        carry: Seconds without landmarks that the IMU alone bridges; then the camera is lost.
        pixel_noise: Standard deviation of a landmark's pixel, errors of its place included.
    """

    carry: Annotated[float, msgspec.Meta(ge=0)] = 3.0
    pixel_noise: Annotated[float, msgspec.Meta(gt=0)] = 0.5


class InertialTracker(FeatureTracker):
    """Tracker of a camera with depth or a stereo rig, and an IMU; reproducible to the bit."""

    def __init__(
        self,
        camera: CameraAnnouncement,  # the camera, or the left one of a rectified rig
        imu: ImuAnnouncement,
        baseline: float,  # metres to the right camera; 0 if there is none
        features: FeatureSettings,
        inertial: InertialSettings,
        stereo: StereoSettings,
    ) -> None:
        cv2.setNumThreads(1)
        matcher = StereoMatcher(camera.info, baseline, stereo) if baseline else None
        super().__init__(camera.info, features, matcher)
        # Blocks misjudge the depth of edges in front of nothing, by which they slide along.
        self._aligns = matcher is None
        self._imu, self._inertial, self._readout = ImuModel(imu), inertial, camera.readout
        mounted = inverse(self._imu.pose) @ pose_matrix(camera.position, camera.orientation)
        common = _COMMON if matcher is None else _COMMON_BY_EYES
        self._filter = InertialFilter(self._imu, mounted, features.keyframes + 1, common)
        # Relative uncertainty of the unit of length, which the baseline is.
        self._scale = stereo.baseline_noise / baseline if baseline else 0.0
        self._samples = np.empty((0, 7))
        self._time: float | None = None  # of the filter, seconds
        self._epoch: int | None = None
        self._seen_at = 0.0
        self._force = np.zeros(3)
        self._doubt = 0.0  # share of the last images whose landmarks contradict
        self._judged_at = 0.0
        self._slot = self._reference_slot = _SLOTS[0]
        self._slot_pose = np.eye(4)

    def fuse(
        self,
        stamp: int,
        image: npt.NDArray[np.uint8],  # of the (left) camera
        other: npt.NDArray[np.uint8] | Depth,  # its depth, or the image of the right camera
        samples: Floats,
    ) -> TrackingResult:
        """Return the pose of the next image; see `Tracker.track`."""
        self._epoch = stamp if self._epoch is None else self._epoch
        now = (stamp - self._epoch) / 1e9
        samples = self._imu.corrected(
            np.column_stack([(samples[:, 0] - self._epoch) / 1e9, samples[:, 1:]])
        )
        self._samples = np.vstack([self._samples, samples])
        self._rates = self._advance(now)
        if self._readout > 0:
            image, other = self._straightened(image, other)
        self._now = now
        self._force = samples[:, 4:].mean(axis=0) if len(samples) else np.zeros(3)
        result = self.track(stamp, image, other)
        if self._time is None:
            return result
        lost = result.lost
        if self._is_known:
            lost &= not self._is_carried
            velocity = (
                self._filter.state.rotation @ self._filter.camera[:3, :3] @ self._camera_velocity()
            )
        else:
            # In a map begun at a guess, a pose is of use when the IMU can carry it.
            lost |= self._maps > 0
            velocity = None
        return msgspec.structs.replace(
            result,
            lost=lost,
            reason=result.reason or ("the velocity is not known yet" if lost else ""),
            velocity=velocity,
            covariance=self._camera_covariance(),
        )

    @property
    def _is_known(self) -> bool:
        """Return whether velocity and gravity are known well enough to continue without images."""
        variances = np.diag(self._filter.covariance)
        return not (self._time is None or self._is_doubted) and bool(
            variances[V].max() < _KNOWN[0] ** 2 and variances[G].max() < _KNOWN[1] ** 2
        )

    def _advance(self, now: float) -> Floats:
        """Advance the filter; return angular velocity and specific force then, shape (6,)."""
        samples = self._samples
        if len(samples):
            newest = np.maximum.accumulate(samples[:, 0])
            samples = samples[np.concatenate([[True], np.diff(newest) > 0])]
        else:
            specific_force = -self._filter.state.gravity @ self._filter.state.rotation
            samples = np.array([[now, 0.0, 0.0, 0.0, *specific_force]])
        start = now if self._time is None else self._time
        inner = samples[(samples[:, 0] > start) & (samples[:, 0] < now), 0]
        times = np.concatenate([[start], inner, [now]])
        rows = self._imu.at(samples, times)
        if now > start:
            self._filter.propagate(self._imu.preintegrate(rows, self._filter.state.bias))
            self._time = now
        used = int(np.searchsorted(samples[:, 0], now)) - 1
        self._samples = samples[max(used, 0) :] if len(self._samples) else self._samples
        rates: Floats = rows[-1, 1:] - self._filter.state.bias
        return rates

    def _camera_velocity(self) -> Floats:
        camera, state = self._filter.camera, self._filter.state
        turning = np.cross(self._rates[:3], camera[:3, 3])
        velocity: Floats = camera[:3, :3].T @ (state.rotation.T @ state.velocity + turning)
        return velocity

    def _camera_covariance(self) -> Floats:
        state, camera = self._filter.state, self._filter.camera
        moved = np.zeros((6, 6))
        moved[:3, :3] = -state.rotation @ cross_matrix(camera[:3, 3])
        moved[:3, 3:], moved[3:, :3] = np.eye(3), state.rotation
        covariance: Floats = moved @ self._filter.covariance[POSE, POSE] @ moved.T
        scale_error = self._scale * self._camera_pose()[:3, 3]
        covariance[:3, :3] += np.outer(scale_error, scale_error)
        return (covariance + covariance.T) / 2

    def _straightened(
        self, image: npt.NDArray[np.uint8], other: npt.NDArray[np.uint8] | Depth
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8] | Depth]:
        """Return both images as if all rows had been exposed with the middle row."""
        turn = self._filter.camera[:3, :3].T @ self._rates[:3]
        velocity = self._camera_velocity() if self._is_known else np.zeros(3)
        rows = ImageRows(self._info, self._readout, turn, velocity)
        if self._matcher is None:
            return rows.image_and_depth(image, np.asarray(other, np.float32))
        return rows.image(image), rows.image(np.asarray(other, np.uint8))

    # Overrides of the map's tracker.

    def _expect(self, grey: Grey) -> Floats | None:
        """Return the IMU's predicted pose, world to camera, once the filter is sure."""
        return inverse(self._camera_pose()) if self._is_known else super()._expect(grey)

    def _starts(self, stamp: int, match: MapMatch | None) -> tuple[list[Floats], bool]:
        return ([self._pose], False) if self._is_known else super()._starts(stamp, match)

    def _find(
        self, grey: Grey, inverse_depths: Depth, expected: Floats, information: Floats | None = None
    ) -> MapMatch | None:
        """Find the map; where nothing is aligned, few landmarks suffice beside the IMU."""
        if not self._aligns and information is None and self._is_known:
            information = None if self._lost_since else _PREDICTED
        return super()._find(grey, inverse_depths, expected, information)

    def _match(self, grey: Grey, inverse_depths: Depth) -> MapMatch | None:
        """Find the map in an image, and correct the filter by the landmarks."""
        match = super()._match(grey, inverse_depths)
        if match is not None:
            sighting = self._sighting(match, inverse_depths)
            agrees = self._filter.update(sighting)
            if len(sighting.places) >= self._enough:  # fewer may all be wrong
                self._judge(agrees and self._filter.misfit(sighting) < _MISFIT)
            match = match if agrees else None
        return None if self._is_doubted else self._corrected(match)

    def _judge(self, agrees: bool) -> None:
        share = min((self._now - self._judged_at) / _PATIENCE, 1.0) if self._is_known else 0.0
        self._doubt += share * ((not agrees) - self._doubt)
        self._judged_at = self._now

    @property
    def _is_doubted(self) -> bool:
        return self._doubt > _DOUBTED

    def _aligned(
        self,
        grey: Grey,  # noqa: ARG002
        inverse_depths: Depth,  # noqa: ARG002
        alignment: Alignment,
        match: MapMatch | None,
    ) -> MapMatch | None:
        if self._is_doubted:
            return None
        if first := bool((alignment.reference == self._slot_pose).all()):
            self._reference_slot = self._slot
        believed, pose = BELIEVED * alignment.information, inverse(alignment.pose)
        if self._filter.update_pose(pose, self._reference_slot, believed, first):
            match = match or MapMatch.without_landmarks(alignment.pose)
        return self._corrected(match)

    def _corrected(self, match: MapMatch | None) -> MapMatch | None:
        self._pose = inverse(self._camera_pose())
        if match is None:
            return None
        self._seen_at = self._now
        return msgspec.structs.replace(match, pose=self._pose)

    def _remember_image(self, grey: Grey, inverse_depths: Depth, aligned: bool) -> None:
        super()._remember_image(grey, inverse_depths, aligned)
        self._slot = _SLOTS[self._reference_slot == _SLOTS[0]]
        self._slot_pose = self._pose
        self._filter.remember(self._slot)

    def _add_keyframe(self, grey: Grey, inverse_depths: Depth, rows: Rows, pixels: Floats) -> None:
        super()._add_keyframe(grey, inverse_depths, rows, pixels)
        number = next(reversed(self._keyframes))
        if number == 0:
            self._filter.forget()
            if self._time is None:  # the first map, or one at a guessed pose
                self._filter.start(self._force, inverse(self._pose))
                self._time = self._seen_at = self._now
                self._doubt = 0.0
            self._remember_image(grey, inverse_depths, False)
        new = np.flatnonzero(self._map.table["keyframe"] == number)
        pixels = self._map.table["pixel"][new]
        read = self._surfaces_at(inverse_depths, pixels, self._settings.depth_noise)
        off = _MISALIGNED / self._matcher.unit if self._matcher is not None else 0.0
        self._filter.remember(number, self._make_sighting(new, pixels, read, _PLACED), off)

    def _lose(self, stamp: int, grey: Grey, inverse_depths: Depth) -> TrackingResult:
        """Return a lost result; after a while, start a map at the IMU's pose or in a new frame."""
        result = self._lost(stamp, "too few landmarks of the map were found")
        waited = stamp - (self._lost_since or stamp)
        if waited < self._settings.reset_timeout * 1e9 and not self._is_doubted:
            return result
        if self._is_carried:
            return self._start_map(stamp, grey, inverse_depths, "by a new map, where the IMU says")
        time, self._time = self._time, None
        reason = ", as its landmarks contradict the IMU" if self._is_doubted else ""
        started = self._start_map(
            stamp, grey, inverse_depths, f"by a new map, at a guessed pose{reason}"
        )
        if started.lost:
            self._time = time
        return started

    @property
    def _is_carried(self) -> bool:
        return self._is_known and self._now - self._seen_at <= self._inertial.carry

    def _camera_pose(self) -> Floats:
        state = self._filter.state
        pose: Floats = transform(state.rotation, state.position) @ self._filter.camera
        return pose

    def _sighting(self, match: MapMatch, inverse_depths: Depth) -> Sighting:
        rows, pixels = match.rows[match.agree], match.pixels[match.agree]
        read = self._surfaces_at(inverse_depths, pixels, self._settings.depth_noise)
        return self._make_sighting(rows, pixels, read, (1.0, 1.0))

    def _make_sighting(
        self, rows: Rows, pixels: Floats, read: Surfaces, noise: tuple[float, float]
    ) -> Sighting:
        """Return landmarks at pixels, with shares of the noise of a pixel and of its depth."""
        measured = rays(pixels, self._matrix)
        measured[:, 2] = read.inverse
        scale = np.empty_like(measured)
        pixel_noise = noise[0] * self._inertial.pixel_noise
        scale[:, :2] = np.array([self._info.fx, self._info.fy]) / pixel_noise
        # A pixel that is off reads the depth beside it, which on a slanted surface is another.
        slant = pixel_noise * np.linalg.norm(read.slope, axis=1)
        noises = [noise[1] * _READING * self._settings.depth_noise, slant, _BENT * read.inverse]
        variance = sum(np.square(noise_part) for noise_part in noises)
        scale[:, 2] = np.where(read.continuous, 1.0 / np.sqrt(variance), 0.0)
        landmarks = self._map.table[rows]
        return Sighting(landmarks["place"], landmarks["keyframe"], measured, scale)


class InertialOdometryConfig(EstimatorConfig):
    """Settings of visual-inertial odometry; the IMU's noise is as announced.

    Attributes:
        inertial: Settings of the fusion with the IMU.
        features: Settings of the map; of a stereo rig, its ``depth_noise`` is that of the matching.
        stereo: Settings of the matching of a stereo rig's images.
    """

    inertial: InertialSettings = InertialSettings()
    features: FeatureSettings = FeatureSettings()
    stereo: StereoSettings = StereoSettings()


class _InertialOdometry(OdometryNode[InertialOdometryConfig]):
    inertial = True
    lenses = frozenset()
    tracks = staticmethod(InertialTracker.fuse)

    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker, and its arguments."""
        camera, config = self.the_camera(), self.config
        if self.imu_announcement is None:
            self.log.fatal("%s", self._missing())
        apart = baseline(*self.cameras) if self.eyes == 2 else 0.0
        settings = config.features, config.inertial, config.stereo
        return InertialTracker, camera, self.imu_announcement, apart, *settings


class RgbdInertialOdometry(_InertialOdometry):
    """Estimates pose, velocity and covariance of a camera with depth and an IMU."""

    needs = frozenset({"grey", "depth"})
    method = "RGB-D-inertial odometry (filter)"

    frames = Bundle(RgbdInertialFrame, keep="latest")


class StereoInertialOdometry(_InertialOdometry):
    """Estimates pose, velocity and covariance of a rectified stereo rig and an IMU."""

    needs = frozenset({"grey"})
    eyes = 2
    method = "stereo-inertial odometry (filter)"

    frames = Bundle(StereoInertialFrame, keep="latest")
