"""A rolling shutter shows each row as it was when it was exposed."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import CameraInfo
from events.frames import from_rpy
from events.geometry import pose_matrix
from runtime.units import Latency
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    Frame,
    add_free_camera,
    camera_info,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras.optics import Lens
from sims.cameras.renderer import Motion, Shot
from sims.cameras.stage import MOST_BANDS, OFF, row_bands, row_time
from tests.sims.cameras.scenes import frames_of, renderer_of

Array = npt.NDArray[np.float64]
READOUT, EXPOSURE = 0.03, 0.006
HERE = (0.0, 0.0, 0.0)
BARREL = Lens(model="plumb_bob", coefficients=(-0.25, 0.06, 0.0, 0.0))
FISHEYE = Lens(model="equidistant", coefficients=(0.02, -0.005, 0.001, -0.0002))


def camera(name: str, **settings: Any) -> CameraSpec:
    defaults: dict[str, Any] = {"width": 192, "height": 144, "position": HERE}
    kinds = ("rgb", "depth", "segmentation")
    return CameraSpec(name=name, images=kinds, **(defaults | settings))  # type: ignore[arg-type]


ROLLING = {"readout": Latency(READOUT)}
CAMERAS = (
    camera("still"),
    camera("plain", **ROLLING),
    camera("barrel", lens=BARREL, **ROLLING),
    camera("fisheye", lens=FISHEYE, fov=170.0, **ROLLING),
    camera("open", width=96, height=72, exposure=Latency(EXPOSURE), **ROLLING),
)


def pose(seconds: float) -> Array:
    """A flight to the right and up, turning; with a vibration that no velocity tells."""
    buzz = 0.01 * math.sin(2 * math.pi * 60.0 * seconds)
    turn = from_rpy(0.4 * seconds, 0.8 * seconds + buzz, 2.5 * seconds)
    return pose_to_qpos((0.3 * seconds, 1.5 * seconds, -0.5 * seconds), turn)


def moving(name: str, reach: float = READOUT + EXPOSURE) -> Shot:
    times = np.arange(-0.5 * reach, 0.5 * reach + 1e-9, 0.0005)
    known = Motion(times, np.array([pose(time) for time in times]))
    exposure = EXPOSURE if name == "open" else 0.0
    return Shot(name, 0, pose(0.0), motion=known, exposure=exposure)


@pytest.fixture(scope="module")
def renderer() -> Any:
    """A wall of coloured balls, 2 to 4 m ahead and all round."""
    world = mujoco.MjSpec()
    world.visual.quality.numslices = world.visual.quality.numstacks = 60
    random = np.random.default_rng(3)
    for k in range(60):
        yaw, height = random.uniform(-2.0, 2.0), random.uniform(-1.6, 1.6)
        reach = random.uniform(2.0, 4.0)
        world.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.17, 0, 0],
            pos=[reach * math.cos(yaw), reach * math.sin(yaw), height],
            rgba=[0.3 + 0.01 * k, 0.9 - 0.01 * k, 0.2 * (k % 5), 1.0],
        )
    prefix = add_free_camera(world, "free", CAMERAS)
    made = renderer_of(model_to_bytes(world.compile()), CAMERAS, prefix, seed=0)
    yield made
    made.close()


@given(height=st.integers(1, 2000), shift=st.floats(0.0, 300.0))
def test_bands_cover_all_rows_and_are_narrow_enough(height: int, shift: float) -> None:
    """Each row once, in order; none farther off its own time than a quarter of a pixel."""
    bands = row_bands(height, shift)
    assert bands[0][0] == 0
    assert bands[-1][1] == height
    assert all(a[1] == b[0] for a, b in pairwise(bands))
    assert all(first < last for first, last in bands)
    if len(bands) < MOST_BANDS and height > 1:
        widest = max(last - first for first, last in bands)
        # Bands are whole rows, of which one may have one more than another.
        assert shift * (widest - 2) / 2.0 / (height - 1) <= OFF


def each_row(height: int, _: float) -> list[tuple[int, int]]:
    return [(row, row + 1) for row in range(height)]


@pytest.mark.parametrize(
    "name",
    ["plain", *(pytest.param(n, marks=pytest.mark.slow) for n in ("barrel", "fisheye", "open"))],
)
def test_rows_and_bands_look_like_one_drawing_for_each_row(
    renderer: CameraRenderer, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bands but for edges, a quarter of a pixel elsewhere; and not like a global shutter."""
    (by_row,) = renderer.expose((moving(name),))
    rolls = renderer._stage.keeps_rows
    monkeypatch.setattr(renderer._stage, "keeps_rows", False)
    (exposed,) = renderer.expose((moving(name),))
    monkeypatch.setattr("sims.cameras.renderer.row_bands", each_row)
    (expected,) = renderer.expose((moving(name),))
    monkeypatch.setattr("sims.cameras.renderer.row_bands", lambda height, _: [(0, height)])
    (at_once,) = renderer.expose((moving(name),))

    def unlike(one: Frame, other: Frame) -> tuple[float, float]:
        assert one.rgb is not None
        assert other.rgb is not None
        colours = np.abs(one.rgb.astype(float) - other.rgb).mean()
        return float(colours), float(np.mean(np.not_equal(one.segmentation, other.segmentation)))  # type: ignore[arg-type]

    near, far = unlike(exposed, expected), unlike(at_once, expected)
    nearest = unlike(by_row, expected)
    if rolls:
        assert nearest[1] < 0.0015
        assert nearest[0] < 0.08 * far[0]  # light is that of the middle
    assert near[1] < 0.015
    assert near[0] < 0.2 * far[0]
    assert near[1] < 0.2 * far[1]
    assert exposed.depth is not None
    assert expected.depth is not None
    same = np.isfinite(exposed.depth) & np.isfinite(expected.depth)
    assert np.quantile(np.abs(exposed.depth[same] - expected.depth[same]), 0.95) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "barrel", "fisheye"])
def test_known_points_fall_on_their_pixels_in_the_row_that_sees_them(
    renderer: CameraRenderer, name: str
) -> None:
    """Each ball's middle, projected with the pose of the row on which it falls."""
    (frame,) = renderer.expose((moving(name),))
    (spec,) = (spec for spec in CAMERAS if spec.name == name)
    info, numbers = camera_info(spec), frame.segmentation
    assert numbers is not None
    model = renderer._model
    errors, skews = [], []
    for number in range(model.ngeom):
        rows, columns = np.nonzero(numbers == number)
        if len(rows) < 60 or rows.min() < 2 or columns.min() < 2:
            continue
        if rows.max() > info.height - 3 or columns.max() > info.width - 3:
            continue
        ring = outline(model.geom_pos[number] * (1, -1, -1), 0.17)
        at_once = [falls(info, point, 0.0) for point in ring]
        places = []
        for point, place in zip(ring, at_once, strict=True):
            for _ in range(6):
                place = falls(info, point, row_time(READOUT, float(place[1]), info.height))
            places.append(place)
        middle, area = centroid(np.array(places))
        if len(rows) > 0.97 * area:  # nothing hides it
            errors.append(np.array([columns.mean(), rows.mean()]) - middle)
            skews.append(middle - centroid(np.array(at_once))[0])
    assert len(errors) >= 5
    assert np.linalg.norm(errors, axis=1).max() < 0.3
    assert np.linalg.norm(skews, axis=1).max() > 1.2


def falls(info: CameraInfo, point: Array, seconds: float) -> Array:
    """The pixel on which a point of the world falls some seconds after the stamp."""
    qpos = pose(seconds)
    turn = pose_matrix((0.0, 0.0, 0.0), tuple(qpos[3:] * (1, 1, -1, -1)))[:3, :3]
    ahead, right, down = turn.T @ (point - qpos[:3] * (1, -1, -1))
    return np.asarray(info.project([[right, down, ahead]])[0])


def outline(centre: Array, radius: float) -> list[Array]:
    """Points in the world that the camera sees at the edge of a ball."""
    distance = float(np.linalg.norm(centre))
    ahead = centre / distance
    side = np.cross(ahead, [0.2, 0.9, 0.1])
    side /= np.linalg.norm(side)
    out = math.tan(math.asin(radius / distance))
    return [
        distance * (ahead + out * (math.cos(t) * side + math.sin(t) * np.cross(ahead, side)))
        for t in np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    ]


def centroid(polygon: Array) -> tuple[Array, float]:
    """The middle and the size of the area of a polygon."""
    u, v = (polygon - polygon[0]).T
    cross = u * np.roll(v, -1) - np.roll(u, -1) * v
    sums = [((c + np.roll(c, -1)) * cross).sum() for c in (u, v)]
    return np.array(sums) / (3.0 * cross.sum()) + polygon[0], abs(0.5 * cross.sum())


def test_the_first_and_the_last_row_have_poses_of_their_own(renderer: CameraRenderer) -> None:
    """Those of the true states then; a global shutter has none."""
    (frame,) = renderer.expose((moving("plain"),))
    assert frame.ends is not None
    for at, (position, _) in zip((-0.5, 0.5), frame.ends, strict=True):
        np.testing.assert_allclose(position, pose(at * READOUT)[:3] * (1, -1, -1), atol=1e-6)
    np.testing.assert_allclose(frame.position, HERE, atol=1e-12)
    assert renderer.expose((moving("still"),))[0].ends is None


def test_at_rest_a_rolling_shutter_is_a_global_one(renderer: CameraRenderer) -> None:
    """Bit by bit."""
    still, rolling = (
        frames_of(renderer, 0, pose(0.0), (name,))[name] for name in ("still", "plain")
    )
    np.testing.assert_array_equal(still.rgb, rolling.rgb)
    np.testing.assert_array_equal(still.depth, rolling.depth)
    np.testing.assert_array_equal(still.segmentation, rolling.segmentation)
