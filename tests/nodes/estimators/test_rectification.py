"""Rectified images: where points fall in them, what is refused, and estimators that read them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    EstimatorAnnouncement,
    Image,
    PoseEstimate,
    TrackedFeatures,
)
from events.camera_info import DistortionModel
from events.geometry import pose_matrix, pose_tuples
from nodes.estimators import Estimator, RgbdFrame, StereoFrame, TrackingResult
from nodes.estimators.rectification import WIDEST, Rectification, misalignment
from runtime import Bundle
from runtime.errors import NodeError
from runtime.testing import run_nodes, spec

AHEAD = (0.5, 0.5, 0.5, 0.5)
WIDTH, HEIGHT = 64, 48
EUROC = CameraInfo(
    width=752, height=480, fx=458.654, fy=457.296, cx=367.215, cy=248.375,
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
)  # fmt: skip
FREIBURG1 = CameraInfo(
    width=640, height=480, fx=517.3, fy=516.5, cx=318.6, cy=255.3,
    distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
)  # fmt: skip
FISHEYE_150 = CameraInfo(
    width=320, height=280, fx=122.0, fy=122.0, cx=159.5, cy=139.5,
    distortion_model="equidistant", distortion=(-0.012, 0.006, -0.003, 0.0004),
)  # fmt: skip


def seen(info: CameraInfo, source: str = "drone/cam", **more: Any) -> CameraAnnouncement:
    fields: dict[str, Any] = {
        "stamp": 0,
        "source": source,
        "images": ("grey",),
        "info": info,
        "rate": 10.0,
        "latency": 0.0,
        "frame_id": f"{source}_optical",
        "parent_frame_id": "base_link",
        "position": (0.0, 0.0, 0.0),
        "orientation": AHEAD,
    }
    return CameraAnnouncement(**(fields | more))


def share(most: float) -> st.SearchStrategy[float]:
    return st.floats(-most, most)


@st.composite
def lenses(draw: st.DrawFn) -> CameraInfo:
    """Lenses of all models, with coefficients that leave the whole image within their range."""
    models: tuple[DistortionModel, ...] = ("plumb_bob", "rational_polynomial", "equidistant")
    model = draw(st.sampled_from(models))
    tangential = draw(share(0.003)), draw(share(0.003))
    radial = draw(share(0.3)), draw(share(0.08))
    coefficients: tuple[float, ...] = {
        "plumb_bob": (*radial, *tangential, draw(share(0.02))),
        "rational_polynomial": (
            *radial,
            *tangential,
            0.0,
            draw(share(0.1)),
            draw(share(0.02)),
            0.0,
        ),
        "equidistant": (draw(share(0.03)), draw(share(0.01)), 0.0, 0.0),
    }[model]
    focal = draw(st.floats(0.45 if model == "equidistant" else 0.7, 2.0)) * WIDTH
    info = CameraInfo(
        width=WIDTH, height=HEIGHT, fx=focal, fy=focal * draw(st.floats(0.98, 1.02)),
        cx=(WIDTH - 1) / 2 + draw(share(4.0)), cy=(HEIGHT - 1) / 2 + draw(share(4.0)),
        distortion_model=model, distortion=coefficients,
    )  # fmt: skip
    corners = [[u, v] for u in (0, WIDTH / 2, WIDTH - 1) for v in (0, HEIGHT / 2, HEIGHT - 1)]
    assume(bool(np.isfinite(info.unproject(corners)).all()))
    return info


def made(*cameras: CameraAnnouncement) -> Rectification:
    try:
        return Rectification(cameras)
    except ValueError:  # too little is left of it, which has tests of its own
        assume(False)
        raise


@pytest.mark.slow
@given(lenses(), st.integers(0, 2**32 - 1))
def test_what_the_lens_sees_falls_on_the_pinholes_pixel(info: CameraInfo, seed: int) -> None:
    rectified = made(seen(info))
    pinhole = rectified.cameras[0].info
    assert pinhole.is_pinhole
    random = np.random.default_rng(seed)
    pixels = random.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (50, 2))
    points = pinhole.unproject(pixels) * random.uniform(0.5, 30.0, (50, 1))
    there = rectified.eyes[0].original(pixels)
    np.testing.assert_allclose(there, info.project(points), atol=1e-6)
    assert ((there > -1e-6) & (there < (WIDTH - 1 + 1e-6, HEIGHT - 1 + 1e-6))).all(), "no black"


@pytest.mark.slow
@given(lenses(), lenses(), st.lists(share(0.06), min_size=6, max_size=6), st.floats(0.03, 0.5))
def test_both_eyes_show_a_point_on_one_row(
    left: CameraInfo, right: CameraInfo, turns: list[float], baseline: float
) -> None:
    """However they were turned against each other; the mounts say where the new axes point."""
    cameras = []
    for info, side, turn, x in ((left, "l", turns[:3], 0.0), (right, "r", turns[3:], baseline)):
        matrix = pose_matrix((0.0, x, 0.01 * x), AHEAD)
        matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        position, orientation = pose_tuples(matrix)
        cameras.append(seen(info, f"drone/{side}", position=position, orientation=orientation))
    rectified = made(*cameras)
    assert misalignment(*rectified.cameras) < 1e-6
    points = np.random.default_rng(1).uniform((1, -1, -1), (9, 1, 1), (40, 3)) * (1, 4, 3)  # FRD
    rows = []
    for own, new, eye in zip(cameras, rectified.cameras, rectified.eyes, strict=True):
        optical = [np.linalg.inv(pose_matrix(c.position, c.orientation)) for c in (own, new)]
        own_pixels, pixels = (
            camera.info.project(points @ m[:3, :3].T + m[:3, 3])
            for camera, m in zip((own, new), optical, strict=True)
        )
        in_view = np.isfinite(own_pixels).all(axis=1)
        np.testing.assert_allclose(eye.original(pixels)[in_view], own_pixels[in_view], atol=1e-5)
        rows.append(pixels)
    np.testing.assert_allclose(rows[0][:, 1], rows[1][:, 1], atol=1e-6)
    assert (rows[0][:, 0] > rows[1][:, 0]).all()


@pytest.mark.parametrize(
    ("info", "focal", "across"), [(EUROC, 421, 83), (FREIBURG1, 549, 60), (FISHEYE_150, 112, 110)]
)
def test_the_middle_keeps_its_resolution(info: CameraInfo, focal: float, across: float) -> None:
    """The lenses of known data sets, and a fisheye, whose rim is cut off."""
    pinhole = Rectification([seen(info)]).cameras[0].info
    assert pinhole.fx == pinhole.fy == pytest.approx(focal, rel=0.01)
    assert math.degrees(2 * math.atan(info.width / 2 / pinhole.fx)) == pytest.approx(across, abs=1)
    assert (pinhole.cx, pinhole.cy) == (info.cx, info.cy)
    assert 2 * math.atan((info.width - 1) / 2 / pinhole.fx) <= WIDEST + 1e-9


@pytest.mark.slow
def test_a_drawn_image_and_its_depth_become_the_pinholes() -> None:
    """A ramp of brightness and two depths, which must not be mixed."""
    rectified = Rectification([seen(EUROC)])
    pinhole = rectified.cameras[0].info

    def x_of(info: CameraInfo) -> npt.NDArray[np.float64]:
        rows, columns = np.mgrid[0 : info.height, 0 : info.width]
        rays = info.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
        return (rays[:, 0] / rays[:, 2]).reshape(info.height, info.width)

    of_lens, of_pinhole = x_of(EUROC), x_of(pinhole)
    grey = np.rint(128 + 90 * of_lens).clip(0, 255).astype(np.uint8)
    depth = np.where(of_lens < 0, 2.0, 7.0).astype(np.float32)
    frame = RgbdFrame(
        Image(stamp=1, source="drone/cam", frame_id="f", encoding="mono8", data=grey),
        DepthImage(stamp=1, source="drone/cam", frame_id="f", data=depth),
    )
    image, depths = rectified.frame(frame)
    assert np.abs(image.data - (128 + 90 * of_pinhole)).max() < 1.2
    assert set(np.unique(depths.data)) == {2.0, 7.0}
    wrong = depths.data != np.where(of_pinhole < 0, 2.0, 7.0)
    assert wrong.mean() < 0.002
    with pytest.raises(ValueError, match="expected 752×480 pixels, as the camera announced"):
        rectified.frame(frame._replace(depth=DepthImage(
            stamp=1, source="drone/cam", frame_id="f", data=depth[::2, ::2],
        )))  # fmt: skip


def test_what_cannot_be_a_pair_or_a_pinhole_is_refused() -> None:
    left = seen(EUROC, "drone/l")
    ahead_of_it = seen(EUROC, "drone/r", position=(0.1, 0.0, 0.0))
    with pytest.raises(ValueError, match="expected drone/r to the right of drone/l"):
        Rectification([left, ahead_of_it])
    with pytest.raises(ValueError, match="expected drone/r to the right"):
        Rectification([left, seen(EUROC, "drone/r")])  # at the same place
    back = seen(EUROC, "drone/r", position=(0.0, 0.1, 0.0), orientation=(0.5, -0.5, -0.5, 0.5))
    with pytest.raises(ValueError, match="to look the same way"):
        Rectification([left, back])
    turning_back = CameraInfo(
        width=WIDTH, height=HEIGHT, fx=20.0, fy=20.0, cx=31.5, cy=23.5,
        distortion=(-0.9, 0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"expected a lens .* found plumb_bob"):
        Rectification([seen(turning_back)])


class Watching(Estimator):
    """Says that its camera turns about the optical axis of what it reads, and points at a pixel."""

    needs = frozenset({"grey"})
    lenses = frozenset()
    eyes = 2
    frames = Bundle(StereoFrame)

    async def run(self) -> None:
        async for left, right in self.frames:
            info = self.the_camera().info
            assert info.is_pinhole
            assert left.data.shape == right.data.shape == (info.height, info.width)
            pose = np.eye(4)
            pose[2, 3] = 1.0
            corner = np.array([[0.0, 0.0]], np.float32)
            self.publish(left, TrackingResult(pose, points=corner, inliers=np.array([True])))


def eyes(**more: Any) -> list[Any]:
    """Return the announcements of a rig whose eyes are turned outwards, and an exposure."""
    cameras, images = [], []
    for name, y, turn in (("drone/l", -0.05, -0.03), ("drone/r", 0.05, 0.05)):
        matrix = pose_matrix((0.2, y, 0.0), AHEAD)
        matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
        orientation = pose_tuples(matrix)[1]
        rest: dict[str, Any] = {"position": (0.2, y, 0.0), "orientation": orientation, **more}
        cameras.append(seen(FISHEYE_150, name, **rest))
        data = np.full((280, 320), 99, np.uint8)
        frame = f"{name}_optical"
        images.append(Image(stamp=1, source=name, frame_id=frame, encoding="mono8", data=data))
    cameras[1] = seen(
        FISHEYE_150, "drone/r", position=cameras[1].position, orientation=cameras[1].orientation,
        stereo="drone/l", baseline=0.1,
    )  # fmt: skip
    return [*cameras, *images]


def test_poses_are_the_bodys_and_points_those_of_the_cameras_own_image() -> None:
    result = run_nodes([spec(Watching, "est")], inputs=eyes(), duration=1.0)
    (estimate,) = result.of(PoseEstimate)
    # A metre along the rectified axis, ahead; the left eye's own one is turned by 0.03.
    np.testing.assert_allclose(estimate.position, (1.0, 0.0, 0.0), atol=1e-9)
    (features,) = result.of(TrackedFeatures)
    assert not np.allclose(features.points, 0.0, atol=5.0)
    assert (features.points > 0.0).all(), "the new corner lies within the fisheye's image"
    (said,) = result.of(EstimatorAnnouncement)
    assert said.rectifies


def test_a_pair_that_is_not_aligned_is_refused_if_it_may_not_be_rectified() -> None:
    flat = CameraInfo.from_fov(320, 280, 1.5)
    cameras = [
        seen(flat, "drone/l"),
        seen(flat, "drone/r", position=(0.0, 0.1, 0.03), stereo="drone/l", baseline=0.1),
    ]
    nodes = [spec(Watching, "est", {"rectify": False})]
    with pytest.raises(NodeError, match="drone/r: expected its rows aligned with those of drone/l"):
        run_nodes(nodes, inputs=cameras, duration=1.0)
