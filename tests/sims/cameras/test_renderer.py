"""The renderer gives the same bits every time, everywhere, and says what is wrong."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    Frame,
    GraphicsError,
    add_free_camera,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras import opengl as graphics
from sims.cameras.stage import RendererName
from tests.sims.cameras.scenes import CAMERAS, frames_of, renderer_of, scene

pytestmark = pytest.mark.usefixtures("draws")

QPOS = pose_to_qpos((1.0, 0.4, -1.5), (0.9, 0.05, -0.1, 0.4))
NAMES = ("all", "wide", "noisy")


@pytest.fixture(scope="module")
def renderer(draws: str) -> Iterator[CameraRenderer]:
    built = scene("hall")
    made = renderer_of(built.packed, CAMERAS, built.prefix, seed=3)
    yield made
    made.close()


def digest(frames: dict[str, Frame]) -> str:
    """One hash of all pixels and poses of some frames."""
    total = hashlib.sha256()
    for name in sorted(frames):
        frame = frames[name]
        total.update(repr((name, frame.position, frame.orientation)).encode())
        for image in (frame.rgb, frame.grey, frame.depth, frame.segmentation):
            total.update(b"" if image is None else image.tobytes())
    return total.hexdigest()


def elsewhere(packed: bytes, prefix: str, draws: RendererName) -> str:
    """Render in this process and return the hash; runs in a spawned one."""
    made = CameraRenderer(packed, CAMERAS, prefix, seed=3, renderer=draws)
    frames_of(made, 1, pose_to_qpos((0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 0.0)), ("noisy",))
    try:
        return digest(frames_of(made, 7, QPOS, NAMES))
    finally:
        made.close()


@pytest.mark.slow
def test_same_state_same_bits(renderer: CameraRenderer) -> None:
    """What was drawn in between leaves no trace."""
    first = digest(frames_of(renderer, 7, QPOS, NAMES))
    frames_of(renderer, 8, pose_to_qpos((-3.0, 1.0, -2.0), (0.2, 0.0, 0.0, 1.0)), NAMES)
    assert digest(frames_of(renderer, 7, QPOS, NAMES)) == first


@pytest.mark.slow
def test_same_bits_in_other_processes(renderer: CameraRenderer, draws: RendererName) -> None:
    """Two spawned processes draw, and add noise, exactly as this one does."""
    built = scene("hall")
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        jobs = [pool.apply_async(elsewhere, (built.packed, built.prefix, draws)) for _ in range(2)]
        digests = {job.get(timeout=50) for job in jobs}
    assert digests == {digest(frames_of(renderer, 7, QPOS, NAMES))}


def test_one_camera_is_drawn_the_same_alone_and_among_others(renderer: CameraRenderer) -> None:
    """A camera's image doesn't depend on which others were asked for, or in which order."""
    together = frames_of(renderer, 7, QPOS, ("wide", "noisy", "all"))
    for name in NAMES:
        alone = frames_of(renderer, 7, QPOS, (name,))
        assert digest(alone) == digest({name: together[name]})


def test_a_frame_holds_what_the_spec_asks_for(renderer: CameraRenderer) -> None:
    """Shapes and types are the announced ones, and what wasn't asked for is None."""
    frames = frames_of(renderer, 7, QPOS, NAMES)
    everything, plain = frames["all"], frames["wide"]
    shapes = [
        None if image is None else (image.dtype, image.shape, image.flags.c_contiguous)
        for image in (everything.rgb, everything.grey, everything.depth, everything.segmentation)
    ]
    assert shapes == [
        (np.dtype(np.uint8), (240, 320, 3), True),
        (np.dtype(np.uint8), (240, 320), True),
        (np.dtype(np.float32), (240, 320), True),
        (np.dtype(np.int32), (240, 320), True),
    ]
    assert plain.grey is None
    assert plain.segmentation is None
    assert plain.stamp == 7


def test_noise_has_the_announced_size(renderer: CameraRenderer) -> None:
    """Grey levels vary with the spec's sigma, depth with k z²; another stamp draws anew."""
    shots = [frames_of(renderer, stamp, QPOS, ("noisy",))["noisy"] for stamp in range(12)]
    rgb = np.array([shot.rgb for shot in shots], np.float64)
    middle = (rgb.mean(0) > 40) & (rgb.mean(0) < 215)
    assert rgb.std(0, ddof=1)[middle].mean() == pytest.approx(4.0, rel=0.05)
    depth = np.array([shot.depth for shot in shots], np.float64)
    ratio = depth.std(0, ddof=1) / (0.002 * depth.mean(0) ** 2)
    assert ratio.mean() == pytest.approx(1.0, rel=0.05)


def test_rows_run_down_and_columns_right() -> None:
    """A red ball ahead to the left and a blue one to the right and low appear so."""
    spec = CameraSpec(name="c", width=64, height=64, position=(0.0, 0.0, 0.0))
    world = mujoco.MjSpec()
    ball = mujoco.mjtGeom.mjGEOM_SPHERE
    for colour, place in (([1, 0, 0, 1], (3, -1, 0)), ([0, 0, 1, 1], (3, 1, 1))):
        x, y, z = place
        world.worldbody.add_geom(type=ball, size=[0.4, 0, 0], pos=[x, -y, -z], rgba=colour)
    prefix = add_free_camera(world, "b", (spec,))
    made = renderer_of(model_to_bytes(world.compile()), (spec,), prefix, seed=0)
    image = frames_of(made, 0, pose_to_qpos((0, 0, 0), (1, 0, 0, 0)), ("c",))["c"].rgb
    made.close()
    assert image is not None
    red, blue = image[31, 21].astype(int), image[42, 42].astype(int)
    assert red[0] > red[2] + 50
    assert blue[2] > blue[0] + 50


@pytest.mark.slow
def test_wrong_arguments_are_named(renderer: CameraRenderer) -> None:
    """A state of the wrong length, an unknown camera and a closed renderer are told apart."""
    built = scene("hall")
    with pytest.raises(ValueError, match=r"expected shape \(7,\), found \(3,\)"):
        frames_of(renderer, 0, np.zeros(3), ("all",))
    with pytest.raises(KeyError, match="nobody"):
        frames_of(renderer, 0, QPOS, ("nobody",))
    with pytest.raises(ValueError, match="camera free/other: expected one of the model's"):
        renderer_of(built.packed, (CameraSpec(name="other"),), built.prefix, seed=0)
    small = (CAMERAS[2],)
    closed = renderer_of(built.packed, small, built.prefix, seed=0)
    closed.close()
    closed.close()
    with pytest.raises(RuntimeError, match="closed"):
        frames_of(closed, 0, QPOS, ("noisy",))


def test_missing_libraries_are_named_with_their_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where EGL cannot be loaded the message says what to install."""

    def broken(name: str) -> None:
        raise ImportError("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr("sims.cameras.opengl.importlib.import_module", broken)
    with pytest.raises(GraphicsError, match="apt-get install libegl1 libgl1"):
        graphics.open_context(8, 8, 1)


@pytest.mark.slow
def test_importing_changes_no_environment() -> None:
    """Neither MUJOCO_GL nor LP_NUM_THREADS is touched before a renderer is made."""
    names = ("MUJOCO_GL", "LP_NUM_THREADS", "PYOPENGL_PLATFORM")
    code = (
        "import os, sims.cameras, sims.worlds; "
        f"assert not set(os.environ) & set({names}), dict(os.environ)"
    )
    clean = {key: value for key, value in os.environ.items() if key not in names}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
