"""Stages: a model with a state and a time, drawn for cameras by one renderer or another."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from typing import Any, Literal, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from events.frames import flip_yz, flip_yz_rotation
from runtime.errors import MissingDependencyError
from sims.cameras.view import Drawn, View

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


Floats = npt.NDArray[np.float64]

NEAR = 0.02
FAR = 20_000.0
"""Clipping planes, metres."""

SHADOW_SIZE = 1024  # pixels; the most columns and rows of a light's map of what it shines on

LOOK = ".look"  # suffix of looks: geom `<name>.look` is the image of geom `<name>`, with its number


class Changing(Protocol):
    """Moving and changing parts of a world, as a stage needs them."""

    @property
    def fog(self) -> bool:
        """Whether there is fog."""

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Set the world to its state at a time."""


class Stage(ABC):
    """Stage for the geoms of groups 0 to 2 (MuJoCo's default) of a model.

    Not thread-safe: stay in the thread that made it.
    """

    keeps_rows = False
    """Whether it draws each row at its own time, by `keep`."""

    def __init__(self, model: Any, dynamics: Changing | None = None) -> None:
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
    """Return each geom's object number: its own id, or for a look its solid's."""
    numbers = np.arange(model.ngeom, dtype=np.int32)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.endswith(LOOK):
            solid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name.removesuffix(LOOK))
            if solid >= 0:
                numbers[geom] = solid
    return numbers
