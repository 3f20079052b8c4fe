"""Stages (a model with a state and a time), and their drawings for a camera."""

from __future__ import annotations

import ctypes
import functools
import itertools
import math
import re
from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple, Protocol

import cv2
import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.base import Quaternion, Vector3
from events.frames import flip_yz, flip_yz_rotation
from runtime.errors import MissingDependencyError
from sims.cameras.optics import Maps, pixel_rays

RendererName = Literal["raster", "mujoco"]
"""``raster``: the rasteriser of this project; ``mujoco``: MuJoCo's, by OpenGL."""


class GraphicsError(MissingDependencyError, RuntimeError):
    """Rendering is impossible here: what it needs of the machine is missing or broken."""


def keep_memory() -> None:
    """Make glibc's allocator, if here, keep the freed memory of images for reuse.

    glibc maps a large array anew, page by page: a tenth of the time of a plain camera's image.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD of malloc.h
        mallopt(-3, 1 << 25)  # M_MMAP_THRESHOLD: the most that it takes


def return_memory() -> None:
    """Have glibc's allocator, if here, return what is free of it to the system.

    What a thread has freed stays with the thread's arena: half a gigabyte after a large scan.
    """
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(ctypes.c_size_t(0))


Floats = npt.NDArray[np.float64]

NEAR = 0.02
FAR = 20_000.0
"""Clipping planes, metres."""

SHADOW_SIZE = 1024  # pixels; the most columns and rows of a light's map of what it shines on

LOOK = ".look"  # suffix of looks: geom `<name>.look` is the image of geom `<name>`, with its number
CHUNK = re.compile(r"\.chunk\d+$")  # suffix of an object's parts: all have the number of the first


class Changing(Protocol):
    """Moving and changing parts of a world, as a stage needs them."""

    @property
    def fog(self) -> bool:
        """Whether there is fog."""

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Set the world to its state at a time."""


def check_settings(model: Any) -> None:
    """Check what a model says of its drawing; `ValueError` for numbers without a meaning."""
    for name in ("shadowsize", "numslices", "numstacks", "numquads"):
        if (count := int(getattr(model.vis.quality, name))) < 0:
            raise ValueError(f"visual/quality: {name}: expected 0 or more, found {count}")
    if not 1e-9 <= model.stat.extent < math.inf:
        raise ValueError(
            f"statistic: extent: expected a number from 1e-9 m, found {model.stat.extent:g} m"
        )
    for number, fall in enumerate(model.light_attenuation.tolist()):
        if not all(0.0 <= part < math.inf for part in fall):
            raise ValueError(
                f"light {model.light(number).name or number}: attenuation: expected numbers of at "
                f"least 0, found {' '.join(f'{part:g}' for part in fall)}"
            )


class Stage(ABC):
    """Stage for the geoms of groups 0 to 2 (MuJoCo's default) of a model.

    Not thread-safe: stay in the thread that made it.

    Raises:
        ValueError: The model says of its drawing what has no meaning.
    """

    keeps_rows = False
    """Whether it draws each row at its own time, by `keep`."""

    def __init__(self, model: Any, dynamics: Changing | None = None) -> None:
        check_settings(model)
        self.model = model
        self._dynamics = dynamics
        self._data = mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED

    @property
    @abstractmethod
    def closed(self) -> bool:
        """Whether it is closed."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of what draws."""

    @abstractmethod
    def enter(self) -> None:
        """Make this stage the thread's."""

    @abstractmethod
    def close(self) -> None:
        """Give back what it holds. Further calls do nothing."""

    def keep(self, camera_id: int, qpos: Floats, seconds: float) -> None:
        """Keep a camera's view of a state and time for the rows of the next drawing.

        Of kept states the first is that of the first row and the last that of the last row, with
        the others between at equal steps. The drawing's light is that of the state last looked at.
        """
        raise NotImplementedError

    @abstractmethod
    def draw(
        self,
        view: View,
        colour: bool,
        depth: bool,
        numbers: bool,
        rows: tuple[int, int] | None = None,
    ) -> Drawn:
        """Draw the requested images of the camera last looked through, or some rows of them."""

    def look(self, camera_id: int, qpos: Floats, seconds: float = 0.0, light: float = 1.0) -> None:
        """Set up the scene of a camera for a state and time; `light` is a factor on all lights."""
        model, data = self.model, self._data
        self._place(qpos, seconds)
        mujoco.mj_comPos(model, data)  # lights that track something ask for it
        mujoco.mj_camlight(model, data)
        self._camera.fixedcamid = camera_id
        self._update()
        if light != 1.0:
            with np.errstate(over="ignore", invalid="ignore"):  # they are bounded when drawn
                for source in self._scene.lights[: self._scene.nlight]:
                    for part in (source.ambient, source.diffuse, source.specular):
                        part *= light

    def _place(self, qpos: Floats, seconds: float) -> None:
        """Set all bodies to a state and time."""
        self._data.qpos[:] = qpos
        if self._dynamics is not None:
            self._dynamics.apply(self.model, self._data, seconds)
        mujoco.mj_kinematics(self.model, self._data)

    @abstractmethod
    def _update(self) -> None:
        """Bring `_scene` up to date, its lights above all."""

    def _fog(self) -> tuple[float, float] | None:
        """Return start and end of the fog, metres; None without."""
        if self._dynamics is None or not self._dynamics.fog:
            return None
        fog, extent = self.model.vis.map, self.model.stat.extent
        return fog.fogstart * extent, fog.fogend * extent

    def move(self, qpos: Floats) -> None:
        """Have `pose` tell of another state, at less cost than `look`; then look before drawing."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)

    def pose(self, camera_id: int) -> tuple[Vector3, Quaternion]:
        """Return a camera's optical pose in ``map``, at the state last looked at."""
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self._data.cam_xmat[camera_id])
        if quat[0] < 0.0:
            quat = -quat  # the same rotation; one sign for it, so that logs read smoothly
        w, x, y, z = quat.tolist()
        # The half turn about x on both sides also turns MuJoCo's camera (-z ahead) into optical.
        position = flip_yz(tuple(self._data.cam_xpos[camera_id].tolist()))
        return position, flip_yz_rotation((w, x, y, z))


def object_numbers(model: Any) -> npt.NDArray[np.int32]:
    """Return each geom's object number: its own id, a look's solid's, or that of ``.chunk0``."""
    numbers = np.arange(model.ngeom, dtype=np.int32)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.endswith(LOOK):
            first = name.removesuffix(LOOK)
        elif (chunk := CHUNK.search(name)) is not None:
            first = f"{name[: chunk.start()]}.chunk0"
        else:
            continue
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, first)
        if number >= 0:
            numbers[geom] = number
    return numbers


Colours = npt.NDArray[np.uint8]
Depths = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int32]

RANGE = 500.0  # metres; depth beyond it is ``inf``
CREASE = 1e-3  # least second difference of the inverse depth, as a share, between two surfaces


class Drawn(NamedTuple):
    """Requested images of a camera, for some of its rows."""

    colours: Colours | None  # uint8, shape (rows, width, 3); black where no ray falls on the image
    # float32 planar depth of the optical frame, metres, shape (rows, width); ``inf`` where nothing
    # is, and 90° or more off the axis, where it would not be positive.
    depth: Depths | None
    numbers: Numbers | None  # int32 object numbers, shape (rows, width); -1 where nothing is


class View(msgspec.Struct, frozen=True):
    """View of a camera; `framed`: the model's camera has just this frame."""

    info: CameraInfo
    framed: bool = False


def stacked(pieces: list[Drawn]) -> Drawn:
    """Return bands of rows, from the top, joined into an image."""
    if len(pieces) == 1:
        return pieces[0]
    colours, depth, numbers = zip(*pieces, strict=True)
    return Drawn(*(None if p[0] is None else np.concatenate(p) for p in (colours, depth, numbers)))


def looked_up(drawn: Drawn, columns: Maps, rows: Maps) -> Drawn:
    """Return images whose pixels lie at other places of the given ones, shape (h, w) each.

    Colours are interpolated, numbers are the nearest pixel's. Of depth the inverse, linear on any
    plane, is interpolated; where surfaces meet it is the nearest pixel's.
    """
    colours, depth, numbers = drawn
    if colours is not None:
        colours = np.asarray(cv2.remap(colours, columns, rows, cv2.INTER_LINEAR), np.uint8)
    if depth is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.reciprocal(depth)  # 0 where nothing is
            bent = ~(np.abs(cv2.Laplacian(inverse, cv2.CV_32F)) <= CREASE * inverse)
            rough = cv2.remap(np.where(bent, np.uint8(255), np.uint8(0)), columns, rows, 1)
            nearest = cv2.remap(inverse, columns, rows, cv2.INTER_NEAREST)
            smooth = cv2.remap(inverse, columns, rows, cv2.INTER_LINEAR)
            inverse = np.where(rough > 0, nearest, smooth)
            depth = np.asarray(np.reciprocal(inverse), np.float32)
    if numbers is not None:
        numbers = np.asarray(
            cv2.remap(numbers, columns, rows, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, -1),
            np.int32,
        )
    return Drawn(colours, depth, numbers)


OFF = 0.25  # largest shift of a row drawn at another row's time, pixels

FINER_FOR_DEPTH = 2.5
"""Times as many bands where depth is wanted: on a slanted floor a pixel is some centimetres."""

MOST_BANDS = 128  # most bands per image; beyond 64 pixels of motion in a readout, rows exceed `OFF`
SAMPLES = 32  # longer side of the small image for motion measurement, pixels


def row_time(readout: float, row: float, height: int) -> float:
    """Return the seconds from an image's stamp to the middle of a row's exposure."""
    return readout * (row / (height - 1) - 0.5) if height > 1 else 0.0


def row_bands(height: int, shift: float) -> list[tuple[int, int]]:
    """Return bands of rows (first, last + 1) for an image's shift in the readout (pixels)."""
    count = min(max(math.ceil(0.5 * shift / OFF), 1), height, MOST_BANDS)
    edges = np.linspace(0, height, count + 1).round().astype(int).tolist()
    return list(itertools.pairwise(edges))


def small_camera(info: CameraInfo) -> CameraInfo:
    """Return a camera with the same view and few pixels."""
    share = min(SAMPLES / max(info.width, info.height), 1.0)
    width, height = max(round(info.width * share), 1), max(round(info.height * share), 1)
    across, down = width / info.width, height / info.height
    return msgspec.structs.replace(
        info,
        width=width,
        height=height,
        fx=info.fx * across,
        fy=info.fy * down,
        cx=(info.cx + 0.5) * across - 0.5,
        cy=(info.cy + 0.5) * down - 0.5,
    )


_rays = functools.lru_cache(maxsize=64)(lambda small: pixel_rays(small).reshape(-1, 3))


def image_speeds(
    info: CameraInfo,
    small: CameraInfo,
    depth: npt.NDArray[np.float32],
    poses: list[Floats],
    seconds: float,
) -> Floats:
    """Return the greatest speed of each point that stays in sight, pixels per second, shape (n,).

    Args:
        depth: Planar depth as the small camera sees it at the middle pose, shape (h, w).
        poses: The optical frame in ``map``, (4, 4), at an odd number of times at equal intervals.
    """
    rays = _rays(small)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = depth.reshape(-1) / rays[:, 2]
    points = rays * np.where(np.isfinite(scale), scale, RANGE)[:, None]
    middle = poses[len(poses) // 2]
    points = points[np.isfinite(points).all(axis=1)] @ middle[:3, :3].T + middle[:3, 3]
    places = np.array([info.project((points - pose[:3, 3]) @ pose[:3, :3]) for pose in poses])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=2)
    steps = steps[:, np.isfinite(steps).all(axis=0)].max(axis=0, initial=0.0)
    return np.append(steps * (len(poses) - 1) / seconds, 0.0)
