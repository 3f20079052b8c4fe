"""Other people's programs, which know nothing of ours, find in our sensors what we put there."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, Image, Odometry
from events.frames import from_geodetic, to_geodetic
from runtime import Node, NodeConfig, on
from runtime.config.reading import load
from runtime.run.execute import execute
from runtime.testing import spec

ROOT = Path(__file__).parents[2]

places = st.tuples(st.floats(-85, 85), st.floats(-179, 179), st.floats(-100, 4000))
offsets = st.tuples(*[st.floats(-20_000, 20_000)] * 2, st.floats(-3000, 100))


@pytest.mark.slow
@given(places, offsets)
def test_proj_sees_the_place_where_a_receiver_is(
    origin: tuple[float, float, float], position: tuple[float, float, float]
) -> None:
    pyproj = pytest.importorskip("pyproj")
    latitude, longitude, height = origin
    place = f"+lat_0={latitude} +lon_0={longitude} +h_0={height}"
    to_enu = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        f"+ellps=WGS84 +step +proj=topocentric +ellps=WGS84 {place}"
    )
    geodetic = to_geodetic(position, origin)
    east, north, up = to_enu.transform(geodetic[1], geodetic[0], geodetic[2])
    assert (north, east, -up) == pytest.approx(position, abs=1e-5)
    assert from_geodetic(geodetic, origin) == pytest.approx(position, abs=1e-5)


class Keeper(Node[NodeConfig]):
    """Keeps images, the camera, and where the camera was."""

    images: ClassVar[list[Image]] = []
    poses: ClassVar[dict[int, Odometry]] = {}
    cameras: ClassVar[list[CameraAnnouncement]] = []

    def on_announcement(self, announcement: Any) -> None:
        if isinstance(announcement, CameraAnnouncement):
            self.cameras.append(announcement)

    @on(Image, Odometry)
    def events(self, event: Image | Odometry) -> None:
        if isinstance(event, Image):
            self.images.append(event)
        else:
            self.poses[event.stamp] = event


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_colmap_finds_lens_and_places_from_images_alone(tmp_path: Path) -> None:
    """Focal length, principal point, four coefficients, and where each image was taken."""
    pycolmap = pytest.importorskip("pycolmap")
    changed = {
        "rate": "2",
        "cameras.eye.images": "['rgb']",
        "cameras.eye.width": "640",
        "cameras.eye.height": "480",
        "cameras.eye.noise": "2.0",
        "cameras.eye.lens.model": "plumb_bob",
        "cameras.eye.lens.coefficients": "[-0.28, 0.075, 0.0002, -0.0001]",
    }
    overrides = [f"camera.{name}={value}" for name, value in changed.items()]
    config = load(ROOT / "examples" / "computer_vision.toml", overrides)
    nodes = (config.nodes[0], spec(Keeper, "keeper", {}))
    execute(msgspec.structs.replace(config, nodes=nodes), None)
    folder = tmp_path / "images"
    folder.mkdir()
    for number, image in enumerate(Keeper.images):
        cv2.imwrite(str(folder / f"{number:03}.png"), image.data[:, :, ::-1])
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    single = {"camera_mode": pycolmap.CameraMode.SINGLE, "reader_options": reader}
    pycolmap.extract_features(tmp_path / "d.db", folder, **single)
    pycolmap.match_exhaustive(tmp_path / "d.db")
    maps = pycolmap.incremental_mapping(tmp_path / "d.db", folder, tmp_path / "map").values()
    model = max(maps, key=lambda map_: map_.num_reg_images())  # its threads may begin a second
    assert model.num_reg_images() >= 20
    (camera,) = model.cameras.values()
    fx, fy, cx, cy, *lens = camera.params
    info = Keeper.cameras[0].info
    # Its threads race: from run to run a focal length is 0.05 to 0.2 % off.
    assert (fx, fy) == pytest.approx((info.fx, info.fy), rel=4e-3)
    # COLMAP's pixels have their centres at halves; it leaves the principal point in the middle.
    assert (cx - 0.5, cy - 0.5) == pytest.approx((info.cx, info.cy), abs=0.5)
    assert lens == pytest.approx(info.distortion[:4], abs=3e-3)
    images = [Keeper.images[int(Path(view.name).stem)] for view in model.images.values()]
    centres = np.array([view.projection_center() for view in model.images.values()])
    body_from_camera = np.array(Keeper.cameras[0].position)
    truth = np.array(
        [
            np.array(pose.position)
            + Rotation.from_quat(pose.orientation, scalar_first=True).apply(body_from_camera)
            for pose in (Keeper.poses[image.stamp] for image in images)
        ]
    )
    assert np.sqrt(np.mean(misfit(centres, truth) ** 2)) < 0.02


def misfit(points: Any, truth: Any) -> Any:
    """Return the distances that remain after the best similarity, metres (S. Umeyama, 1991)."""
    a, b = points - points.mean(0), truth - truth.mean(0)
    u, sizes, v = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    turn = u @ sign @ v
    scale = np.trace(np.diag(sizes) @ sign) / np.sum(a**2)
    return np.linalg.norm(scale * a @ turn.T - b, axis=1)
