"""The worker that draws what clients ask for, in a process of its own."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.base import Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD, flip_yz, flip_yz_rotation, multiply
from events.geometry import pose_matrix
from sims.airsim.server.image_types import OF_DEPTH, OF_NUMBERS, Form, ImageType, Seen, packed
from sims.cameras.renderer import model_from_bytes
from sims.cameras.spec import CameraSpec, camera_info, is_plain, vertical_fov
from sims.cameras.stage import Changing, Floats, Stage, keep_memory
from sims.cameras.view import View

Mount = tuple[Vector3, Quaternion]
"""Position on the body, metres FRD, and rotation of the camera's axes (FRD) to the body's."""


class Eye(NamedTuple):
    """What an image is drawn from.

    Attributes:
        body: Number in the model of the body that carries the camera.
        mount: Where on it.
        spec: Size, field of view or intrinsics, and light; an ideal pinhole.
    """

    body: int
    mount: Mount
    spec: CameraSpec


class Wanted(NamedTuple):
    """One image that is wanted: from where, of which type, and as what it is sent."""

    eye: Eye
    kind: ImageType
    form: Form


class Renderer:
    """Draws images of a model from any place on its bodies.

    Not thread-safe: stay in the thread that made it.

    Args:
        model_bytes: From `sims.cameras.model_to_bytes`.
        camera: Name of a camera of the model, which is moved to where it is needed.
        size: Width and height of the largest drawing, pixels.
        threads: Threads of the software renderer, if this is the process's first GL context.
        dynamics: What moves in the world by itself.
    """

    def __init__(
        self,
        model_bytes: bytes,
        camera: str,
        size: tuple[int, int],
        threads: int = 1,
        dynamics: Changing | None = None,
    ) -> None:
        keep_memory()
        self._model: Any = model_from_bytes(model_bytes)
        self._camera = int(self._model.camera(camera).id)
        self._make = partial(Stage, self._model, *size, threads, dynamics)

    def take(
        self, stamp: int, qpos: Floats, ids: npt.NDArray[np.uint8], wanted: Sequence[Wanted]
    ) -> list[npt.NDArray[np.uint8]]:
        """Return images of one state, as they are sent, in the order in which they are wanted.

        What several of them show from one place is drawn once.

        Args:
            stamp: Time of the state (ns).
            qpos: The state, shape (nq,).
            ids: Segmentation ID of each object number, and last of nothing, shape (ngeom + 1,).
            wanted: The images.

        Raises:
            GraphicsError: There is no GL; the message names what to install.
        """
        self._stage.enter()
        images: dict[int, npt.NDArray[np.uint8]] = {}
        places: dict[Eye, list[int]] = {}
        for number, each in enumerate(wanted):
            places.setdefault(each.eye, []).append(number)
        for eye, numbers in places.items():
            seen = self._see(eye, stamp, qpos, ids, {wanted[n].kind for n in numbers})
            images |= {n: packed(wanted[n].kind, seen, wanted[n].form) for n in numbers}
        return [images[n] for n in range(len(wanted))]

    def close(self) -> None:
        """Give the GL context back."""
        if "_stage" in self.__dict__:
            self._stage.close()

    @cached_property
    def _stage(self) -> Stage:
        return self._make()  # by the first images: without GL, all else is served

    def _see(
        self,
        eye: Eye,
        stamp: int,
        qpos: Floats,
        ids: npt.NDArray[np.uint8],
        kinds: set[ImageType],
    ) -> Seen:
        model, number, (position, turn) = self._model, self._camera, eye.mount
        model.cam_bodyid[number] = eye.body
        model.cam_pos[number] = flip_yz(position)
        model.cam_quat[number] = flip_yz_rotation(multiply(turn, OPTICAL_TO_FRD))
        model.cam_fovy[number] = vertical_fov(eye.spec)
        self._stage.look(number, qpos, stamp * 1e-9, eye.spec.light)
        view = _view(camera_info(eye.spec), is_plain(eye.spec))
        drawn = view.draw(
            self._stage, ImageType.SCENE in kinds, bool(kinds & OF_DEPTH), bool(kinds & OF_NUMBERS)
        )
        return Seen(drawn, view.info, ids, pose_matrix(*self._stage.pose(number))[:3, :3])


@lru_cache(maxsize=64)
def _view(info: CameraInfo, framed: bool) -> View:
    return View(info, framed)
