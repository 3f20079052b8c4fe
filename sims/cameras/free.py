"""A camera without a vehicle: its state is a pose, and nothing moves it but the user."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from events.base import Quaternion, Vector3
from events.frames import flip_yz, flip_yz_rotation, normalize
from sims.cameras.spec import CameraSpec, add_camera


def add_free_camera(world: mujoco.MjSpec, name: str, specs: tuple[CameraSpec, ...]) -> str:
    """Add a body that carries cameras, meets nothing and falls nowhere.

    Args:
        world: The world, which is changed. If nothing else in it moves, its whole state is then
            `pose_to_qpos`.
        name: The body's; the cameras are called ``<name>/<camera>``.
        specs: The cameras.

    Returns:
        The prefix of the cameras' names, as `CameraRenderer` takes it.

    Raises:
        ValueError: The world has a body of that name, or two specs share theirs.
    """
    if world.body(name) is not None:
        raise ValueError(f"free camera {name}: expected a name of its own, but the world has one")
    # A free joint, because the renderer takes qpos; a mass, because a free joint needs one.
    body = world.worldbody.add_body(
        name=name, gravcomp=1.0, explicitinertial=True, mass=0.1, inertia=[1e-4, 1e-4, 1e-4]
    )
    body.add_freejoint(name=name)
    prefix = f"{name}/"
    for spec in specs:
        add_camera(world, name, spec, prefix)
    return prefix


def pose_to_qpos(position: Vector3, orientation: Quaternion) -> npt.NDArray[np.float64]:
    """Return a free camera's qpos, shape (7,), from its body's pose.

    Args:
        position: The body's origin, metres in ``map`` (NED).
        orientation: Rotation from the body (FRD) to ``map``; needn't be of unit length.

    Raises:
        ValueError: The quaternion is zero.
    """
    turn = flip_yz_rotation(normalize(orientation))
    return np.array([*flip_yz(position), *turn])


def qvel_between(
    before: npt.NDArray[np.float64], after: npt.NDArray[np.float64], seconds: float
) -> npt.NDArray[np.float64]:
    """Return a free camera's velocity, shape (6,), from its qpos at two times.

    Args:
        before: The earlier qpos, shape (7,).
        after: The later qpos, shape (7,).
        seconds: Time between them.
    """
    turn = np.empty(3)
    mujoco.mju_subQuat(turn, after[3:], before[3:])
    return np.concatenate([after[:3] - before[:3], turn]) / seconds
