"""Rendering of camera exposures, with the effects of lens, shutter and sensor.

A *shot* is *captured* (drawn, at each of its moments) and then *developed* (made a frame: the
images of a sensor); in the thread that made the GL context, in a worker process as a rule.
"""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.base import Quaternion, Vector3
from events.geometry import pose_matrix
from sims.cameras.development import Development
from sims.cameras.opengl import OpenGL
from sims.cameras.optics import generator, grey_of, moments, undistorted
from sims.cameras.packed import Drawable, Packed
from sims.cameras.raster import Raster
from sims.cameras.spec import CameraSpec, camera_info, eyes, is_plain
from sims.cameras.stage import (
    FINER_FOR_DEPTH,
    Changing,
    Colours,
    Depths,
    Drawn,
    Floats,
    RendererName,
    Stage,
    View,
    image_speeds,
    keep_memory,
    looked_up,
    row_bands,
    row_time,
    small_camera,
    stacked,
)


class Motion(NamedTuple):
    """True states of the world while a shutter is open."""

    seconds: Floats  # times of the states after the exposure's stamp, rising, shape (k,)
    qpos: Floats  # generalised positions at these times, shape (k, nq)


class Shot(NamedTuple):
    """Exposure to render: camera, stamp, world state, exposure time and gain."""

    camera: str
    stamp: int  # nanoseconds on the run's clock: the middle row's mid-exposure
    qpos: Floats  # the model's generalised positions then, shape (nq,)
    # Its generalised velocities then, shape (nv,): constant while the shutter is open, unless
    # `motion` is known. None: at rest.
    qvel: Floats | None = None
    # The states from the beginning of the first row's exposure to the end of the last one's; needed
    # by a rolling shutter.
    motion: Motion | None = None
    exposure: float = 0.0  # seconds that the shutter is open
    gain: float = 1.0

    def moves(self) -> bool:
        """Return whether the state may change while the shutter is open."""
        return self.qvel is not None or self.motion is not None

    def state(self, model: Any, seconds: float) -> Floats:
        """Return the generalised positions some seconds after the stamp, shape (nq,)."""
        if seconds == 0.0 or not self.moves():
            return self.qpos
        if self.motion is None:
            assert self.qvel is not None
            start, velocity, since = self.qpos, self.qvel, seconds
        else:
            times, states = self.motion
            if len(times) == 1:
                return np.asarray(states[0])
            after = int(np.clip(np.searchsorted(times, seconds), 1, len(times) - 1))
            start, velocity = states[after - 1], np.empty(model.nv)
            step = float(times[after] - times[after - 1])
            mujoco.mj_differentiatePos(model, velocity, step, start, states[after])
            since = seconds - float(times[after - 1])
        moved: Floats = start.copy()
        mujoco.mj_integratePos(model, moved, velocity, since)
        return moved


class Frame(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Images (None: not in the camera's settings) and pose of an exposure, of the same instant."""

    stamp: int  # nanoseconds on the run's clock: the middle of the middle row's exposure
    position: Vector3  # the optical frame's origin, metres in ``map`` (NED)
    orientation: Quaternion  # rotation from the optical frame to ``map``
    # Of a rolling shutter, position and orientation at the exposure of the first and of the last
    # row; None of a global one.
    ends: tuple[tuple[Vector3, Quaternion], tuple[Vector3, Quaternion]] | None = None
    exposure: float = 0.0  # seconds that the shutter was open
    gain: float = 1.0
    light: float | None = None  # mean light of the image, if it is metered (`Development.meter`)
    rgb: npt.NDArray[np.uint8] | None = None
    grey: npt.NDArray[np.uint8] | None = None
    # float32 metres along the optical z axis, shape (height, width); ``inf`` where nothing was hit.
    depth: npt.NDArray[np.float32] | None = None
    # int32 object numbers (geom ids), shape (height, width); -1 where nothing was hit.
    segmentation: npt.NDArray[np.int32] | None = None
    undistorted: Frame | None = None  # the same images without distortion, if they are wanted


def delay_of(spec: CameraSpec, seed: int, stamp_ns: int) -> float | None:
    """Return the seconds from an exposure to its delivery, or None if lost."""
    # No camera's name has a slash: what is drawn here and the noise are independent.
    random = generator(seed, f"{spec.name}/delivery", stamp_ns)
    if random.random() < spec.loss:
        return None
    return float(spec.latency) + float(spec.jitter) * random.random()


def stamp_error(spec: CameraSpec, seed: int, stamp_ns: int) -> int:
    """Return the delay of an exposure's stamps, nanoseconds."""
    random = generator(seed, f"{spec.name}/stamp", stamp_ns)
    error = float(spec.time_jitter) * random.uniform(-1.0, 1.0) if spec.time_jitter else 0.0
    return round((float(spec.time_offset) + error) * 1e9)


def model_to_bytes(model: Any) -> bytes:
    """Return a compiled model, textures and all, as bytes to send to another process."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def model_from_bytes(data: bytes) -> Any:
    """Return the model of `model_to_bytes`; `ValueError` for other bytes or another MuJoCo's."""
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": data})


def opened(world: Packed | bytes) -> tuple[Any, Drawable | None]:
    """Return the model of a world, and what the rasteriser draws if that is prepared."""
    if isinstance(world, Packed):
        return world.model(), world.drawable
    return model_from_bytes(world), None


def open_stage(
    renderer: RendererName,
    model: Any,
    infos: tuple[CameraInfo, ...],
    threads: int,
    dynamics: Changing | None = None,
    drawable: Drawable | None = None,
) -> Stage:
    """Return a stage of a renderer.

    Args:
        infos: The largest cameras.
        threads: Threads that draw; of OpenGL's software renderer only in the first context.
        drawable: What the rasteriser draws, if that is prepared.

    Raises:
        GraphicsError: What the renderer needs is missing; the message names what to install.
        ValueError: The model holds what the renderer does not draw.
    """
    if renderer == "raster":
        return Raster(model, dynamics, threads, drawable=drawable)
    return OpenGL(model, infos, threads, dynamics)


Pose = tuple[Vector3, Quaternion]

KEPT = 0.002  # most seconds between the states through which rows are drawn


class Captured(NamedTuple):
    """Light on a camera's sensor in an exposure, before the sensor's errors."""

    # uint8 images, shape (height, width, 3), of the moments that make up the exposure, in order;
    # empty if no colour is wanted.
    colours: list[Colours]
    depth: Depths | None  # float32 metres, shape (height, width), if wanted
    numbers: npt.NDArray[np.int32] | None  # int32 object numbers, shape (height, width), if wanted
    # The optical frame's position and orientation in ``map`` at the stamp; of a rolling shutter at
    # the first, the middle and the last row.
    poses: tuple[Pose, ...]


class CameraRenderer:
    """Renderer of all cameras of a model.

    Not thread-safe: stay in the thread that made it.

    Args:
        world: Of the simulator's process, or from `model_to_bytes`; has a camera
            `<prefix><name>` for each spec.
        cameras: Settings of the cameras; a stereo rig is two.
        threads: Threads that draw.
        dynamics: What moves in the world by itself, as `sims.worlds.Dynamics`.
        renderer: What draws.

    Raises:
        GraphicsError: What draws is missing; the message names what to install.
        ValueError: The bytes are no model, the model lacks one of the cameras, or it holds
            something that is not drawn.
    """

    def __init__(
        self,
        world: Packed | bytes,
        cameras: tuple[CameraSpec, ...],
        prefix: str,
        seed: int,
        threads: int = 1,
        dynamics: Changing | None = None,
        renderer: RendererName = "raster",
    ) -> None:
        cameras = tuple(eye for spec in cameras for eye in eyes(spec))
        keep_memory()
        model, drawable = opened(world)
        self._model = model
        self._seed = seed
        self._cameras = {spec.name: (spec, _number(model, prefix + spec.name)) for spec in cameras}
        self._developments = {spec.name: Development(spec) for spec in cameras}
        self._small = {
            spec.name: View(small_camera(camera_info(spec)))
            for spec in cameras
            if spec.readout or spec.longest_exposure
        }
        self._undistorted = {
            spec.name: undistorted(camera_info(spec)) for spec in cameras if spec.undistorted
        }
        self._views = {spec.name: View(camera_info(spec), is_plain(spec)) for spec in cameras}
        infos = tuple(view.info for view in self._views.values())
        self._stage = open_stage(renderer, model, infos, threads, dynamics, drawable)

    def expose(self, shots: tuple[Shot, ...]) -> tuple[Frame, ...]:
        """Return the frames of some exposures. The same arguments give the same bits."""
        if self._stage.closed:
            raise RuntimeError("render: expected an open renderer, found a closed one")
        self._stage.enter()
        frames = []
        for shot in shots:
            _check("qpos", shot.qpos, self._model.nq)
            if shot.qvel is not None:
                _check("qvel", shot.qvel, self._model.nv)
            spec, number = self._cameras[shot.camera]
            due = time.monotonic() + spec.render_time
            frames.append(self._develop(shot, spec, self._capture(shot, spec, number)))
            if spec.render_time:
                # In real time, and not on the run's clock: it stands for a slow renderer.
                time.sleep(max(due - time.monotonic(), 0.0))
        return tuple(frames)

    def graphics(self) -> str:
        """Return the name of what draws: a graphics card, ``llvmpipe``, or ``raster``."""
        return self._stage.name

    def close(self) -> None:
        """Give back what the renderer holds. Further calls do nothing."""
        self._stage.close()

    def _capture(self, shot: Shot, spec: CameraSpec, number: int) -> Captured:
        """Draw light on the sensor: colours at each moment, all else in the middle.

        A rolling shutter's rows are drawn each at its own time, or in bands where the stage cannot.
        """
        kinds, stage, view = set(spec.images), self._stage, self._views[spec.name]
        coloured = not kinds.isdisjoint({"rgb", "grey"})
        exposure = shot.exposure if coloured and shot.moves() else 0.0
        coloured |= spec.depth_sensor is not None and spec.depth_sensor.needs_colours
        readout = float(spec.readout) if shot.moves() else 0.0
        bands: list[tuple[int, int]] = [(0, spec.height)]
        times = [0.0]
        if exposure > 0.0 or (readout > 0.0 and not stage.keeps_rows):
            speeds = self._speeds(shot, spec, number, exposure + readout)
            if not stage.keeps_rows:
                finer = FINER_FOR_DEPTH if "depth" in kinds else 1.0
                bands = row_bands(spec.height, float(speeds.max()) * readout * finer)
            times = moments(exposure, float(np.quantile(speeds, 0.9)) * exposure)
        poses = [
            self._pose(shot, number, moment)
            for moment in ((-0.5 * readout, 0.0, 0.5 * readout) if spec.readout else ())
        ]
        drawn: list[list[Drawn]] = [[] for _ in times]
        for rows in bands:
            middle = row_time(readout, (rows[0] + rows[1] - 1) / 2.0, spec.height)
            for pieces, moment in zip(drawn, times, strict=True):
                if stage.keeps_rows and readout:
                    for late in np.linspace(-0.5, 0.5, math.ceil(readout / KEPT) + 1) * readout:
                        since = float(late) + moment
                        state = shot.state(self._model, since)
                        stage.keep(number, state, shot.stamp * 1e-9 + since)
                self._look(shot, spec, number, middle + moment)
                alone = moment == 0.0
                if not spec.readout and alone:
                    poses.append(stage.pose(number))
                wanted = (coloured, alone and "depth" in kinds, alone and "segmentation" in kinds)
                pieces.append(stage.draw(view, *wanted, rows if len(bands) > 1 else None))
        whole = [stacked(pieces) for pieces in drawn]
        _, depth, numbers = whole[len(whole) // 2]
        return Captured(
            [w.colours for w in whole if w.colours is not None], depth, numbers, tuple(poses)
        )

    def _develop(self, shot: Shot, spec: CameraSpec, captured: Captured) -> Frame:
        random = generator(self._seed, spec.name, shot.stamp)
        development, exposure, gain = self._developments[spec.name], shot.exposure, shot.gain
        rgb = grey = light = None
        if captured.colours:
            if "grey" in spec.images:
                greys = [grey_of(image) for image in captured.colours]
                grey = development.develop(greys, random, exposure, gain)
            if "rgb" in spec.images:
                rgb = development.develop(captured.colours, random, exposure, gain)
            if spec.auto_exposure and (seen := grey if rgb is None else rgb) is not None:
                light = development.meter(seen)
        depth = captured.depth
        if depth is not None:
            depth = development.measure(depth, captured.colours, random)
        poses = captured.poses
        position, orientation = poses[len(poses) // 2]
        frame = Frame(
            stamp=shot.stamp,
            position=position,
            orientation=orientation,
            ends=(poses[0], poses[-1]) if spec.readout else None,
            exposure=exposure,
            gain=gain,
            light=light,
            rgb=rgb,
            grey=grey,
            depth=depth,
            segmentation=captured.numbers,
        )
        if not spec.undistorted:
            return frame
        _, *maps = self._undistorted[spec.name]
        rgb, depth, segmentation = looked_up(Drawn(rgb, depth, captured.numbers), *maps)
        if grey is not None:
            grey = looked_up(Drawn(grey, None, None), *maps).colours
        twin = msgspec.structs.replace(
            frame, rgb=rgb, grey=grey, depth=depth, segmentation=segmentation
        )
        return msgspec.structs.replace(frame, undistorted=twin)

    def _look(self, shot: Shot, spec: CameraSpec, number: int, seconds: float) -> None:
        state = shot.state(self._model, seconds)
        self._stage.look(number, state, shot.stamp * 1e-9 + seconds, spec.light)

    def _pose(self, shot: Shot, number: int, seconds: float) -> Pose:
        self._stage.move(shot.state(self._model, seconds))
        return self._stage.pose(number)

    def _speeds(self, shot: Shot, spec: CameraSpec, number: int, seconds: float) -> Floats:
        """Return the image speeds in view during an exposure, pixels per second."""
        small = self._small[spec.name]
        # At least every 2 ms, or a vibration would be missed.
        times = np.linspace(-0.5, 0.5, 2 * math.ceil(seconds / 0.004) + 1) * seconds
        poses = [pose_matrix(*self._pose(shot, number, moment)) for moment in times.tolist()]
        self._look(shot, spec, number, 0.0)
        depth = self._stage.draw(small, False, True, False).depth
        assert depth is not None
        return image_speeds(camera_info(spec), small.info, depth, poses, seconds)


def _number(model: Any, name: str) -> int:
    number: int = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    if number < 0:
        known = ", ".join(model.camera(i).name for i in range(model.ncam))
        raise ValueError(f"camera {name}: expected one of the model's ({known or 'none'})")
    return number


def _check(what: str, array: npt.NDArray[np.float64], length: int) -> None:
    if array.shape != (length,):
        raise ValueError(f"{what}: expected shape ({length},), found {array.shape}")
