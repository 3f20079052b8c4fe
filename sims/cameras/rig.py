"""Cameras of a vehicle: image events from physics states, rendered beside the event loop."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterable
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

import events as ev
from events.base import Quaternion, Vector3
from runtime import Node, Worker
from runtime.channels.sender import Sender
from sims.cameras.calibration import Calibration, announced, difference
from sims.cameras.optics import ExposureControl, undistorted
from sims.cameras.packed import Packed
from sims.cameras.renderer import CameraRenderer, Frame, Motion, Shot, delay_of, stamp_error
from sims.cameras.spec import CameraSpec, announcement, calibration, eyes, optical_frame
from sims.cameras.stage import RendererName

STEP = 1_000_000  # interval of the states recorded during an exposure, nanoseconds
UNDISTORTED = "/undistorted"  # ends the source of a camera's images without distortion


class CameraOutputs(msgspec.Struct, frozen=True):
    """Outputs of a node with cameras."""

    images: Sender[ev.Image]
    depth_images: Sender[ev.DepthImage]
    segmentation_images: Sender[ev.SegmentationImage]
    camera_poses: Sender[ev.PoseStamped]


class DrawnWorld(Protocol):
    """World as passed to the renderers."""

    dynamics: Any

    @property
    def model_bytes(self) -> bytes:
        """The compiled world, from `model_to_bytes`."""

    def packed(self, renderer: RendererName) -> Packed:
        """Return the world for processes in which this renderer draws."""


States = Callable[[int], npt.NDArray[np.float64]]
"""Gives the world's true generalised positions, shape (nq,), at a time (ns)."""


class _Exposure(NamedTuple):
    spec: CameraSpec
    shots: tuple[Shot, ...]  # of each of its eyes
    due: int  # delivery time (ns), unless the previous exposure's is later
    states: States | None  # gives the states while the shutter is open, when they have come about


class CameraRig:
    """All cameras of a body.

    Every image has the stamp of its exposure (with the error of the camera's clock), and is sent
    `latency` seconds, and up to `jitter` more, after it. Just before, the camera's pose is sent,
    with the same stamp and source; of a rolling shutter also those of the first and the last row.
    The images of a stereo rig's cameras are sent together. A camera with both ``rgb`` and ``grey``
    sends the grey images as ``<source>/grey``; one with ``undistorted`` sends all a second time, as
    ``<source>/undistorted``.

    Args:
        node: The node that carries the cameras; a camera's source is ``<node>/<camera>``.
        specs: The cameras, which the model has under the names ``<node>/<camera>``.
        processes: Number of processes that render; frames go to them in turn.
    """

    def __init__(
        self,
        node: Node[Any],
        specs: tuple[CameraSpec, ...],
        outputs: CameraOutputs,
        processes: int,
        threads: int,
        renderer: RendererName,
    ) -> None:
        self._node = node
        self._specs = {spec.name: spec for spec in specs}
        self._outputs = outputs
        self._processes = processes
        self._threads = threads
        self._draws: RendererName = renderer
        self._renderer: Worker[CameraRenderer] | None = None
        self._seed = 0
        self._last: dict[str, asyncio.Future[None]] = {}
        self._in_flight = dict.fromkeys(self._specs, 0)
        self._controls = {
            spec.name: ExposureControl(spec.auto_exposure, float(spec.reference_exposure))
            for spec in specs
            if spec.auto_exposure is not None
        }
        self.lost = dict.fromkeys(self._specs, 0)  # exposures lost by the camera's `loss` setting
        self.skipped = dict.fromkeys(self._specs, 0)
        """Exposures left out because the renderer was behind; never in lockstep."""

    async def start(self, join: Callable[[], Awaitable[DrawnWorld]]) -> None:
        """Join the world, and start the renderers, or raise a `GraphicsError`."""
        if not self._specs:
            await join()
            return

        async def drawn() -> tuple[Any, ...]:
            world = await join()
            self._node.doing = "starting the renderer of its cameras"
            self._seed = int(self._node.rng.integers(1 << 31))
            return (
                await self._node.offload(lambda: world.packed(self._draws)),
                tuple(self._specs.values()),
                f"{self._node.name}/",
                self._seed,
                self._threads,
                world.dynamics,
                self._draws,
            )

        self._renderer = await self._node.worker(
            CameraRenderer,
            more=drawn,
            processes=self._processes,
            # What draws is ours: MuJoCo need not look for a window's library.
            env={"MUJOCO_GL": "disable"} if self._draws == "raster" else {},
        )
        self._node.doing = ""
        if self._node.checking:
            return
        graphics = await self._renderer.call_for(0.0, CameraRenderer.graphics)
        self._node.log.info("images are drawn by %s", graphics)
        self._node.note_environment("graphics", graphics)

    def change(self, specs: tuple[CameraSpec, ...]) -> None:
        """Take over latency, jitter and loss of these, from the next exposure on."""
        self._specs = {spec.name: spec for spec in specs}

    def announcements(self, parent_frame_id: str) -> Iterable[ev.CameraAnnouncement]:
        """Return the announcements of the cameras."""
        name = self._node.name
        for spec in self._specs.values():
            left, *others = eyes(spec)
            for eye in (left, *others):
                announced = announcement(
                    eye,
                    source=f"{name}/{eye.name}",
                    prefix=f"{name}/",
                    parent_frame_id=parent_frame_id,
                    stamp=self._node.clock.now(),
                    known=self._known(eye),
                )
                if spec.stereo and eye is not left:
                    announced = msgspec.structs.replace(
                        announced,
                        latency=announced.latency - spec.offset,  # both are delivered together
                        baseline=spec.stereo.baseline
                        if spec.wrong is None
                        else math.dist(announced.position, self._known(left).position),
                        stereo=f"{name}/{left.name}",
                    )
                if spec.wrong is not None:  # no word of it is in what anybody can read meanwhile
                    self._node.note_truth(announced.source, difference(announced, calibration(eye)))
                yield announced
                if spec.undistorted:
                    source, (pinhole, _, _) = announced.source, undistorted(announced.info)
                    stereo = announced.stereo and announced.stereo + UNDISTORTED
                    yield msgspec.structs.replace(
                        announced,
                        source=source + UNDISTORTED,
                        undistorted=source,
                        stereo=stereo,
                        info=pinhole,
                    )

    def transforms(self, parent_frame_id: str) -> Iterable[ev.TransformStamped]:
        """Return the pose of each camera's optical frame in the body's, constant for the run."""
        name = self._node.name
        for spec in (eye for entry in self._specs.values() for eye in eyes(entry)):
            known = self._known(spec)
            yield ev.TransformStamped(
                stamp=self._node.clock.now(),
                source=f"{name}/{spec.name}",
                frame_id=parent_frame_id,
                child_frame_id=optical_frame(spec, f"{name}/"),
                translation=known.position,
                rotation=known.orientation,
                static=True,
            )

    def _known(self, eye: CameraSpec) -> Calibration:
        """Return the announced calibration of a camera, or of a rig's eye."""
        true = calibration(eye)
        if eye.wrong is None:
            return true
        return announced(true, eye.wrong, self._node.rng, eye.name)

    @property
    def past(self) -> float:
        """Seconds of past states a vehicle must remember for `expose`."""
        return max(
            (2.0 * spec.half + spec.offset for spec in self._specs.values() if _spans(spec)),
            default=0.0,
        )

    def expose(
        self,
        camera: str,
        stamp: int,
        qpos: npt.NDArray[np.float64],
        qvel: npt.NDArray[np.float64] | None = None,
        states: States | None = None,
    ) -> None:
        """Expose a camera at a state; its events are sent when they are due.

        Args:
            stamp: Time of the state (ns).
            qpos: The state, shape (nq,); not copied.
            qvel: Its velocity, shape (nv,), for motion blur; not copied. None: at rest.
            states: State at other times, for a rolling shutter or a second eye: asked once all rows
                have been exposed.
        """
        spec = self._specs[camera]
        exposure, gain = float(spec.exposure), spec.gain
        if camera in self._controls:
            opens = stamp - round((spec.longest_exposure + spec.readout) / 2.0 * 1e9)
            exposure, gain = self._controls[camera].next(opens)
        shots = tuple(
            Shot(eye.name, stamp, qpos, qvel, exposure=exposure, gain=gain) for eye in eyes(spec)
        )
        delay = delay_of(spec, self._seed, stamp)
        if delay is None:
            self.lost[camera] += 1
            return
        longest = spec.latency + spec.jitter
        on_their_way = math.ceil(longest * spec.rate) + self._processes
        if self._in_flight[camera] > on_their_way:  # in real time the renderer may fall behind
            self.skipped[camera] += 1
            return
        self._in_flight[camera] += 1
        done = asyncio.get_running_loop().create_future()
        before = self._last.get(camera)
        self._last[camera] = done
        due = stamp + round(delay * 1e9)
        asked = states if _spans(spec) else None
        self._node.start(self._deliver(_Exposure(spec, shots, due, asked), before, done))

    def log_missing(self) -> None:
        """Log how many exposures were not delivered, and why."""
        for camera, lost in self.lost.items():
            if lost:
                self._node.log.info("%s: %d exposures lost, as its settings ask", camera, lost)
        for camera, skipped in self.skipped.items():
            if skipped:
                self._node.log.warning(
                    "%s: %d exposures skipped, rendering is too slow", camera, skipped
                )

    async def _deliver(
        self, exposure: _Exposure, before: asyncio.Future[None] | None, done: asyncio.Future[None]
    ) -> None:
        assert self._renderer is not None
        spec, shots, due, states = exposure
        try:
            if states is not None:
                await self._node.clock.sleep_until(shots[0].stamp + _ns(spec.half + spec.offset))
                shots = _in_motion(spec, shots, states)
            wait = max(due - self._node.clock.now(), 0) / 1e9
            frames = await self._renderer.call_for(wait, CameraRenderer.expose, shots)
            # Of two processes, or of two delays, the later may be through first: keep the order.
            if before is not None and not before.done():
                await asyncio.wait([before])
            if (light := frames[0].light) is not None:
                now, (frame, *_) = self._node.clock.now(), frames
                self._controls[spec.name].delivered(now, frame.exposure, frame.gain, light)
            late = stamp_error(spec, self._seed, shots[0].stamp)
            for eye, frame in zip(eyes(spec), frames, strict=True):
                self._send(eye, frame, frame.stamp + late)
        finally:
            self._in_flight[spec.name] -= 1
            done.set_result(None)

    def _send(self, spec: CameraSpec, frame: Frame, stamp: int) -> None:
        source = f"{self._node.name}/{spec.name}"
        frame_id = optical_frame(spec, f"{self._node.name}/")
        poses = [(stamp, (frame.position, frame.orientation))]
        if frame.ends is not None:
            half, (first, last) = _ns(spec.readout / 2.0), frame.ends
            poses = [(stamp - half, first), *poses, (stamp + half, last)]
        self._send_images(source, frame_id, stamp, frame, poses)
        if frame.undistorted is not None:
            self._send_images(source + UNDISTORTED, frame_id, stamp, frame.undistorted, poses)

    def _send_images(
        self,
        source: str,
        frame_id: str,
        stamp: int,
        frame: Frame,
        poses: list[tuple[int, tuple[Vector3, Quaternion]]],
    ) -> None:
        out = self._outputs
        for when, (position, orientation) in poses:
            out.camera_poses.send(
                ev.PoseStamped(
                    stamp=when, source=source, position=position, orientation=orientation
                )
            )
        if frame.depth is not None:
            out.depth_images.send(
                ev.DepthImage(stamp=stamp, source=source, frame_id=frame_id, data=frame.depth)
            )
        if frame.segmentation is not None:
            out.segmentation_images.send(
                ev.SegmentationImage(
                    stamp=stamp, source=source, frame_id=frame_id, data=frame.segmentation
                )
            )
        for encoding, data in (("mono8", frame.grey), ("rgb8", frame.rgb)):
            if data is None:
                continue
            second = encoding == "mono8" and frame.rgb is not None
            out.images.send(
                ev.Image(
                    stamp=stamp,
                    source=f"{source}/grey" if second else source,
                    frame_id=frame_id,
                    encoding=encoding,
                    exposure_time=frame.exposure,
                    gain=frame.gain,
                    data=data,
                )
            )


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _spans(spec: CameraSpec) -> bool:
    return bool(spec.readout or spec.offset)


def _in_motion(spec: CameraSpec, shots: tuple[Shot, ...], states: States) -> tuple[Shot, ...]:
    begin = shots[0].stamp - _ns(spec.half)
    end = shots[0].stamp + _ns(spec.half + spec.offset)
    times = [begin, *range(begin - begin % STEP + STEP, end, STEP), end]
    known = np.array([states(time) for time in times])
    moved = []
    for shot, late in zip(shots, (0, _ns(spec.offset)), strict=False):
        stamp = shot.stamp + late
        motion = Motion((np.array(times) - stamp) * 1e-9, known)
        qpos = states(stamp) if late else shot.qpos
        moved.append(shot._replace(stamp=stamp, qpos=qpos, motion=motion))
    return tuple(moved)
