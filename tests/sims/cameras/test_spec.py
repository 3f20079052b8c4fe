"""Camera specs: how they are written, what they announce, where they sit."""

from __future__ import annotations

import math

import msgspec
import mujoco
import numpy as np
import pytest

from events.frames import rotate
from sims.cameras import (
    CameraSpec,
    add_camera,
    add_free_camera,
    announcement,
    camera_info,
    optical_in_body,
    pose_to_qpos,
)


def test_a_toml_table_becomes_a_spec() -> None:
    """Lists become tuples, and what isn't said has its default."""
    text = 'name = "front"\nimages = ["grey", "depth"]\nfov = 80\norientation = [0, -90, 0]'
    spec = msgspec.toml.decode(text, type=CameraSpec)
    assert spec.images == ("grey", "depth")
    assert spec.orientation == (0.0, -90.0, 0.0)
    assert (spec.width, spec.height, spec.rate, spec.latency) == (512, 512, 30.0, 0.04)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fov = 180", "fov: expected at most 170 degrees without an equidistant lens"),
        ("width = 0", r">= 1 - at `\$.width`"),
        ("rate = 0", r"> 0.0 - at `\$.rate`"),
        ('images = ["infrared"]', r"'infrared' - at `\$.images"),
        ("images = []", "expected one or more kinds, each once, found none"),
        ('images = ["rgb", "rgb"]', "each once, found rgb, rgb"),
        ("fow = 90", "unknown field `fow`"),
    ],
)
def test_mistakes_are_named(text: str, message: str) -> None:
    """A wrong value says where it stands and what was expected."""
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.toml.decode(f'name = "c"\n{text}', type=CameraSpec)


def test_intrinsics_come_from_the_horizontal_field_of_view() -> None:
    """The rim of the outermost column is at half the field of view, at any aspect."""
    info = camera_info(CameraSpec(name="c", width=640, height=480, fov=70.0))
    assert math.atan2(info.width / 2, info.fx) == pytest.approx(math.radians(35.0))
    assert (info.fy, info.cx, info.cy) == (info.fx, 319.5, 239.5)


@pytest.mark.parametrize(
    ("orientation", "ahead", "down"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 0, 1)),
        ((0, -90, 0), (0, 0, 1), (-1, 0, 0)),
        ((0, 0, 90), (0, 1, 0), (0, 0, 1)),
        ((90, 0, 0), (1, 0, 0), (0, -1, 0)),
    ],
)
def test_orientation_follows_the_body_axes(
    orientation: tuple[float, float, float],
    ahead: tuple[float, float, float],
    down: tuple[float, float, float],
) -> None:
    """Pitch -90 looks down with the top of the image ahead; yaw 90 looks right."""
    _, optical = optical_in_body(CameraSpec(name="c", orientation=orientation))
    assert rotate(optical, (0.0, 0.0, 1.0)) == pytest.approx(ahead, abs=1e-12)
    assert rotate(optical, (0.0, 1.0, 0.0)) == pytest.approx(down, abs=1e-12)


def test_the_announcement_repeats_the_spec() -> None:
    """Frames are named after prefix and camera; the pose is the optical frame's."""
    spec = CameraSpec(name="front", images=("rgb",), position=(0.2, 0.1, -0.05))
    said = announcement(spec, source="d/front", prefix="d/", parent_frame_id="d", stamp=5)
    assert (said.frame_id, said.parent_frame_id, said.stamp) == ("d/front_optical", "d", 5)
    assert said.position == (0.2, 0.1, -0.05)
    assert said.orientation == optical_in_body(spec)[1]


def test_names_that_do_not_fit_are_refused() -> None:
    """No such body, and a name that is taken, are said to be so."""
    world = mujoco.MjSpec()
    spec = CameraSpec(name="c")
    with pytest.raises(ValueError, match=r"camera d/c: expected a body of the world \(world\)"):
        add_camera(world, "drone", spec, "d/")
    add_camera(world, "world", spec, "d/")
    with pytest.raises(ValueError, match="camera d/c: expected a name of its own"):
        add_camera(world, "world", spec, "d/")
    add_free_camera(world, "free", ())
    with pytest.raises(ValueError, match="free camera free: expected a name of its own"):
        add_free_camera(world, "free", ())


def test_a_free_camera_stays_where_it_is_put() -> None:
    """Its qpos is its pose in NWU, and a second of physics doesn't move it."""
    world = mujoco.MjSpec()
    add_free_camera(world, "free", (CameraSpec(name="c"),))
    model = world.compile()
    data = mujoco.MjData(model)
    qpos = pose_to_qpos((1.0, 2.0, -3.0), (2.0, 0.0, 0.0, 2.0))
    np.testing.assert_allclose(qpos, [1, -2, 3, 0.5**0.5, 0, 0, -(0.5**0.5)], atol=1e-12)
    data.qpos[:] = qpos
    for _ in range(500):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, qpos, atol=1e-9)
    with pytest.raises(ValueError, match="quaternion"):
        pose_to_qpos((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
