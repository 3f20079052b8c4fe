"""Estimates of scripts, so that they are judged: a method that AirSim does not have."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import msgspec

from events import EstimatorAnnouncement, PoseEstimate, Quaternion, Vector3
from events.frames import inverse, multiply, normalize, rotate
from sims.airsim.server.methods import RpcError, rpc
from sims.airsim.structures import Pose

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

NORMS = 0.99, 1.01
"""Between which the norm of a client's quaternion is: float32, and sums of small rotations."""


class ScriptEstimator(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An estimator in a client's script, which publishes its poses by ``visnavPublishPose``.

    Attributes:
        name: Its name, by which the client publishes; source of its estimates.
        method: What it is, in a word or two, for the report.
        vehicle: The vehicle whose pose it estimates; empty for the first one by name.
        camera: The camera whose poses the client publishes, with AirSim's axes (x forward, y
            right, z down); they become those of the vehicle. Empty: the vehicle's poses.
        frame_id: ``odom``: poses are in a frame of the estimator's own, and aligned by the first
            one. ``map``: they are in the vehicle's local frame, and not aligned.
        scale_free: Whether its unit of length is its own, as that of a single camera is.
        reads: Kinds of data that it computes with: ``grey``, ``depth``, ``imu``, ``lidar``.
    """

    name: str
    method: str = "a script's"
    vehicle: str = ""
    camera: str = ""
    frame_id: Literal["odom", "map"] = "odom"
    scale_free: bool = False
    reads: tuple[str, ...] = ()


class Estimates:
    """Publishes scripts' estimates as those of any estimator of the run."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._estimators = {each.name: each for each in server.config.estimators}
        self._last: dict[str, int] = {}
        if len(self._estimators) < len(server.config.estimators):
            raise ValueError("estimators: expected names of their own, found one twice")
        for each in server.config.estimators:
            try:
                self._mount(each)
            except RpcError as error:
                raise ValueError(f"estimators: {each.name}: {error}") from None

    def announce(self) -> Iterable[EstimatorAnnouncement]:
        """Announce the estimators that clients will be."""
        for each in self._estimators.values():
            yield EstimatorAnnouncement(
                stamp=0,
                source=each.name,
                method=each.method,
                scale_free=each.scale_free,
                reads=each.reads,
                vehicle=each.vehicle,
            )

    @rpc("visnavPublishPose")
    def publish_pose(self, estimator: str, stamp: int, pose: Pose) -> None:
        """Publish a pose that the script has estimated, at an image's stamp (ns), to be judged.

        Raises:
            RpcError: There is no such estimator; the stamp is later than now, or not later than
                that of the pose before; or the pose is none.
        """
        found = self._estimators.get(estimator)
        if found is None:
            names = ", ".join(sorted(self._estimators)) or "none: the setting `estimators` is empty"
            raise RpcError(f"expected an estimator of the settings ({names}), found '{estimator}'")
        last, now = self._last.get(estimator, -1), self._server.clock.now()
        if not last < stamp <= now:
            raise RpcError(f"expected a stamp after {last} and up to {now} ns, found {stamp}")
        position, orientation = _checked(pose)
        if (mount := self._mount(found)) is not None:
            offset, turn = mount
            orientation = normalize(multiply(orientation, inverse(turn)))
            position = _sum(position, rotate(orientation, offset), -1.0)
        if found.frame_id == "map":
            position = _sum(position, self._server.vehicles.find(found.vehicle).origin)
        estimate = PoseEstimate(
            stamp=stamp,
            source=found.name,
            frame_id=found.frame_id,
            position=position,
            orientation=orientation,
        )
        self._last[estimator] = stamp
        self._server.estimates.send(estimate)

    def _mount(self, estimator: ScriptEstimator) -> tuple[Vector3, Quaternion] | None:
        """Return where on its vehicle the camera is whose poses are published, if one's are."""
        vehicle = self._server.vehicles.find(estimator.vehicle)
        if not estimator.camera:
            return None
        return self._server.cameras.find(vehicle, estimator.camera).mount


def _checked(pose: Pose) -> tuple[Vector3, Quaternion]:
    """Return the numbers of a client's pose."""
    position: Vector3 = msgspec.structs.astuple(pose.position)
    orientation: Quaternion = msgspec.structs.astuple(pose.orientation)
    norm = math.hypot(*orientation)
    if not (all(map(math.isfinite, position)) and NORMS[0] <= norm <= NORMS[1]):
        raise RpcError(
            "expected a pose of finite numbers whose orientation is a unit quaternion, "
            f"found {position}, {orientation}"
        )
    return position, normalize(orientation)


def _sum(a: Vector3, b: Vector3, factor: float = 1.0) -> Vector3:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]
