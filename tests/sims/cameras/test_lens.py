"""Where the announced lens says a point falls, the image shows it, and its depth is right."""

from __future__ import annotations

import math
from typing import Any, get_args

import cv2
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import CameraInfo
from events.camera_info import DistortionModel
from sims.cameras import (
    CameraSpec,
    Frame,
    add_free_camera,
    camera_info,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras.optics import LARGEST, Lens, faces, pixel_rays, undistorted
from sims.cameras.stage import RendererName
from tests.sims.cameras.scenes import frames_of, renderer_of

pytestmark = pytest.mark.usefixtures("draws")

Array = npt.NDArray[np.float64]
AHEAD = (1.0, 0.0, 0.0, 0.0)


def camera(name: str, **settings: Any) -> CameraSpec:
    defaults: dict[str, Any] = {"width": 320, "height": 240, "position": (0.0, 0.0, 0.0)}
    return CameraSpec(name=name, images=("rgb", "depth", "segmentation"), **(defaults | settings))


def lens(model: str, *coefficients: float) -> Lens:
    return Lens(model=model, coefficients=coefficients)


RATIONAL = (0.1, -0.2, 1e-4, 2e-4, 0.02, 0.4, -0.1, 0.01)
FISHEYE = lens("equidistant", 0.02, -0.005, 0.001, -0.0002)
CAMERAS = (
    camera("off_centre", intrinsics=(210.0, 260.0, 130.5, 140.25)),
    camera("radtan", fov=95.0, lens=lens("plumb_bob", -0.28, 0.07, 0.0006, -0.0004)),
    camera("pincushion", fov=80.0, lens=lens("plumb_bob", 0.1, 0.02, 0.0, 0.0, 0.001)),
    camera(
        "rational",
        fov=85.0,
        lens=lens("rational_polynomial", *(0.1, -0.2, 1e-4, 2e-4, 0.02), 0.4, -0.1, 0.01),
    ),
    camera("kb4", fov=100.0, lens=lens("equidistant", -0.01, 0.005, -0.002, 0.0003)),
    camera("kb4_own", intrinsics=(150.0, 163.0, 150.0, 128.0), lens=FISHEYE),
    camera("widest", width=301, height=280, fov=195.0, lens=FISHEYE),
    camera("all_round", width=200, height=200, fov=330.0, lens=lens("equidistant", 0, 0, 0, 0)),
)


def render(
    spec: CameraSpec, world: Any, position: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Frame:
    prefix = add_free_camera(world, "free", (spec,))
    renderer = renderer_of(model_to_bytes(world.compile()), (spec,), prefix, seed=0)
    frame = frames_of(renderer, 0, pose_to_qpos(position, AHEAD), (spec.name,))[spec.name]
    renderer.close()
    return frame


def outline(info: CameraInfo, centre: Array, radius: float) -> Array:
    """Pixels of a ball's outline, by OpenCV wherever it can, shape (n, 2)."""
    distance = np.linalg.norm(centre)
    ahead = centre / distance
    side = np.cross(ahead, [0.3, 0.9, -0.4])
    side /= np.linalg.norm(side)
    other = np.cross(ahead, side)
    turn = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    half = math.asin(radius / distance)
    ring = math.cos(half) * ahead + math.sin(half) * (
        np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
    )
    zero = np.zeros(3)
    if ring[:, 2].min() < 0.05:
        return info.project(ring)
    if info.distortion_model == "equidistant":
        distortion = np.array(info.distortion, np.float64)
        points = ring[:, None] / ring[:, None, 2:]
        projected = cv2.fisheye.projectPoints(points, zero, zero, info.matrix(), distortion)[0]
        return np.asarray(projected[:, 0], np.float64)
    return np.asarray(
        cv2.projectPoints(ring, zero, zero, info.matrix(), np.array(info.distortion))[0][:, 0]
    )


def centroid(polygon: Array) -> Array:
    """The middle of the area of a polygon, shape (2,)."""
    x, y = (polygon - polygon[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = [((c + np.roll(c, -1)) * cross).sum() for c in (x, y)]
    return np.asarray(np.array(sums) / (3.0 * cross.sum()) + polygon[0])


def balls(info: CameraInfo) -> tuple[Array, Array]:
    """Centres in the optical frame (n, 3) and radii (n,), metres, all over the image."""
    columns, rows = np.meshgrid(
        np.linspace(40, info.width - 41, 4), np.linspace(40, info.height - 41, 3)
    )
    rays = info.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    rays = rays[np.isfinite(rays[:, 0])]
    distance = np.random.default_rng(1).uniform(1.5, 6.0, len(rays))
    return rays * distance[:, None], distance * min(22.0 / max(info.fx, info.fy), 0.25)


@pytest.mark.slow
@pytest.mark.parametrize("spec", CAMERAS, ids=lambda spec: spec.name)
def test_known_points_fall_on_their_pixels(spec: CameraSpec, draws: RendererName) -> None:
    """Balls at known places are seen where OpenCV projects their outlines.

    MuJoCo's outlines have steps; those of the rasteriser are smooth.
    """
    limit = 0.04 if draws == "raster" else 0.1  # pixels
    info = camera_info(spec)
    centres, radii = balls(info)
    world = mujoco.MjSpec()
    world.visual.quality.numslices = world.visual.quality.numstacks = 80
    for part in ("ambient", "diffuse", "specular"):
        setattr(world.visual.headlight, part, [0.0, 0.0, 0.0])
    world.add_material(name="white", emission=1.0, rgba=[1, 1, 1, 1])
    for (x, y, z), radius in zip(centres, radii, strict=True):
        # The optical axes of a camera that looks north: x east, y down.
        world.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0, 0],
            pos=[z, -x, -y],
            material="white",
        )
    frame = render(spec, world)
    assert frame.rgb is not None
    light = (frame.rgb[..., 0] / 255.0) ** 2  # as outlines are blended
    rows, columns = np.mgrid[0 : info.height, 0 : info.width]
    errors = []
    for centre, radius in zip(centres, radii, strict=True):
        expected = outline(info, centre, radius)
        if (expected < 2).any() or (expected > (info.width - 3, info.height - 3)).any():
            continue
        around = np.zeros(light.shape, np.uint8)
        cv2.fillPoly(around, [np.rint(expected).astype(np.int32)], 1)
        share = light * cv2.dilate(around, np.ones((7, 7), np.uint8))
        seen = np.array([(columns * share).sum(), (rows * share).sum()]) / share.sum()
        errors.append(seen - centroid(expected))
    assert len(errors) >= 6
    length = np.linalg.norm(errors, axis=1)
    assert length.max() < limit
    assert np.abs(np.mean(errors, axis=0)).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("spec", CAMERAS, ids=lambda spec: spec.name)
def test_depth_is_planar_and_exact_on_planes(spec: CameraSpec) -> None:
    """Of floor and walls, at any slant, within what the depth buffer resolves; numbers as well."""
    info = camera_info(spec)
    world = mujoco.MjSpec()
    room = {"floor": (2, 1.5), "ahead": (0, 4.0), "right": (1, 3.0), "left": (1, -2.5)}
    for name, (axis, distance) in room.items():
        size, place = [20.0, 20.0, 20.0], [0.0, 0.0, 0.0]
        size[axis] = 0.1
        place[axis] = distance + math.copysign(0.1, distance)
        x, y, z = place
        world.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[x, -y, -z]
        )
    frame = render(spec, world)
    assert frame.depth is not None
    assert frame.segmentation is not None
    rays = pixel_rays(info)
    north_east_down = rays[..., [2, 0, 1]]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.stack([d / north_east_down[..., axis] for axis, d in room.values()])
        ranges = np.where(ranges > 0.0, ranges, np.inf)
        first = ranges.argmin(axis=0)
        expected = ranges.min(axis=0) * rays[..., 2]
    hit = np.isfinite(rays[..., 2]) & (ranges.min(axis=0) < 15.0)
    # Away from the edges between two walls.
    label, around = np.where(hit, first, 9).astype(np.uint8), np.ones((5, 5), np.uint8)
    sure = hit & (cv2.dilate(label, around) == cv2.erode(label, around))
    np.testing.assert_array_equal(frame.segmentation[sure], first[sure])
    ahead = sure & (rays[..., 2] > 0.01)
    share = np.abs(frame.depth[ahead] / expected[ahead] - 1.0)
    assert ahead.sum() > 0.15 * ahead.size
    assert np.quantile(share, 0.98) < 4e-5
    assert share.max() < 0.03
    assert np.isinf(frame.depth[rays[..., 2] <= 0.0]).all()


def test_what_the_lens_does_not_see_is_empty() -> None:
    """Black, at infinity, and no object's: outside the circle of a fisheye."""
    spec = camera(
        "round", width=120, height=120, fov=200.0, lens=lens("equidistant", 0, -0.02, 0, 0)
    )
    world = mujoco.MjSpec()
    world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[9, 0, 0])
    world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[9, 9, 0.1], pos=[0, 0, -2])
    info = camera_info(spec)
    wide = CameraSpec(name="wide", width=200, height=120, position=(0.0, 0.0, 0.0),
        images=("rgb", "depth", "segmentation"), lens=spec.lens,
        intrinsics=(info.fx, info.fy, 99.5, 59.5))  # fmt: skip
    frame = render(wide, world)
    assert frame.rgb is not None
    assert frame.depth is not None
    assert frame.segmentation is not None
    unseen = np.isnan(pixel_rays(camera_info(wide))[..., 0])
    assert 0.05 < unseen.mean() < 0.9
    assert not frame.rgb[unseen].any()
    assert np.isinf(frame.depth[unseen]).all()
    assert (frame.segmentation[unseen] == -1).all()
    assert (frame.segmentation[~unseen] >= 0).mean() > 0.4


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (9, 1), (33, 2)])
@pytest.mark.parametrize("fov", [40.0, 190.0])
def test_odd_sizes_are_drawn(size: tuple[int, int], fov: float) -> None:
    """Down to a single pixel."""
    spec = camera("odd", width=size[0], height=size[1], fov=fov, lens=FISHEYE)
    world = mujoco.MjSpec()
    world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 9, 9], pos=[3.1, 0, 0])
    frame = render(spec, world)
    assert frame.depth is not None
    assert frame.depth.shape == size[::-1]
    middle = frame.depth[size[1] // 2, size[0] // 2]
    assert middle == pytest.approx(3.0, abs=1e-4)


@pytest.mark.slow
@given(
    data=st.data(),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    focal=st.floats(3.0, 60.0),
    stretch=st.floats(0.7, 1.4),
)
@settings(max_examples=60, deadline=None)
def test_every_ray_is_looked_up_in_one_face(
    data: st.DataObject, width: int, height: int, focal: float, stretch: float
) -> None:
    """At the pixel of the face that shows it, away from the face's edge; whatever the lens."""
    model: DistortionModel = data.draw(st.sampled_from(get_args(DistortionModel)))
    small = st.floats(-0.1, 0.1)
    if model == "equidistant":
        distortion = tuple(data.draw(st.tuples(*[small] * 4)))
    else:
        k1, k2, k3 = data.draw(st.tuples(*[st.floats(-0.3, 0.3)] * 3))
        p1, p2 = data.draw(st.tuples(*[st.floats(-0.005, 0.005)] * 2))
        distortion = (k1, k2, p1, p2, k3, *([0.1, 0.02, 0.0] if model[0] == "r" else []))
    cx, cy = data.draw(st.tuples(st.floats(0, width), st.floats(0, height)))
    info = CameraInfo(
        width=width, height=height, fx=focal, fy=focal * stretch, cx=cx, cy=cy,
        distortion_model=model, distortion=distortion,
    )  # fmt: skip
    rays = pixel_rays(info)
    seen = np.isfinite(rays[..., 0])
    count = np.zeros(seen.shape, int)
    for face in faces(info):
        if face.columns is None or face.rows is None or face.mask is None:
            assert info.is_pinhole
            return
        assert max(face.width, face.height) <= LARGEST
        count += face.mask
        columns, rows = face.columns[face.mask], face.rows[face.mask]
        assert columns.min() >= 1.0
        assert rows.min() >= 1.0
        assert columns.max() <= face.width - 2.0
        assert rows.max() <= face.height - 2.0
        x = face.left + (columns + 0.5) * face.pitch[0]
        y = face.top + (rows + 0.5) * face.pitch[1]
        back = np.column_stack([x, y, np.ones(len(x))]) @ face.turn
        back /= np.linalg.norm(back, axis=1)[:, None]
        assert np.linalg.norm(back - rays[face.mask], axis=1).max() < 2e-3 * max(face.pitch) + 1e-6
    np.testing.assert_array_equal(count, seen)


@pytest.mark.slow
def test_the_undistorted_twin_agrees_with_opencv() -> None:
    """Its maps are those of OpenCV's rectification."""
    info = camera_info(CAMERAS[1])
    pinhole, columns, rows = undistorted(info)
    assert pinhole.is_pinhole
    expected = cv2.initUndistortRectifyMap(
        info.matrix(), np.array(info.distortion), np.eye(3), pinhole.matrix(),
        (info.width, info.height), cv2.CV_32FC1,
    )  # fmt: skip
    np.testing.assert_allclose(columns, expected[0], atol=2e-3)
    np.testing.assert_allclose(rows, expected[1], atol=2e-3)


@pytest.mark.slow
def test_the_undistorted_twin_shows_the_same_world() -> None:
    """Nearly the image, and the depth, of a pinhole camera in the same place."""
    spec = camera("twin", fov=90.0, lens=CAMERAS[1].lens, undistorted=True)
    info = camera_info(spec)
    ideal = camera("ideal", intrinsics=(info.fx, info.fy, info.cx, info.cy))
    frames = []
    for lens in (spec, ideal):
        world = mujoco.MjSpec()
        for k in range(-6, 7):
            world.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[0.1, 0.3, 0.3],
                pos=[3 + 0.1 * k, 0.8 * k, 0.4 * (k % 3 - 1)],
                rgba=[0.9, 0.1 * (k % 7), 0.4, 1],
            )
        frames.append(render(lens, world))
    twin, expected = frames[0].undistorted, frames[1]
    assert twin is not None
    assert twin.rgb is not None
    assert twin.depth is not None
    assert expected.rgb is not None
    assert expected.depth is not None
    assert twin.segmentation is not None
    assert expected.segmentation is not None
    alike = twin.segmentation == expected.segmentation
    assert alike.mean() > 0.985
    same = alike & np.isfinite(expected.depth)
    assert same.mean() > 0.1
    assert np.quantile(np.abs(twin.depth[same] / expected.depth[same] - 1.0), 0.9) < 1e-3
    assert np.abs(twin.rgb[same].astype(int) - expected.rgb[same]).mean() < 3.0
