"""AirSim's types of image, from what a camera sees."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import CameraInfo
from sims.airsim import wire
from sims.airsim.server.image_types import (
    SKY,
    Form,
    ImageType,
    Seen,
    as_colours,
    as_numbers,
    packed,
    palette,
    surface_normals,
)
from sims.cameras.view import Drawn

INFO = CameraInfo.from_fov(16, 12, math.radians(90.0))
RAYS = INFO.unproject(np.mgrid[0:12, 0:16][::-1].reshape(2, -1).T).reshape(12, 16, 3)
"""Unit rays of all pixels."""


def seen(
    depth: npt.NDArray[np.float32] | None = None,
    colours: npt.NDArray[np.uint8] | None = None,
    numbers: npt.NDArray[np.int32] | None = None,
) -> Seen:
    ids = np.array([7, 0, 255, 0], np.uint8)
    return Seen(Drawn(colours, depth, numbers), INFO, ids, np.eye(3))


def plane(normal: npt.NDArray[np.float64], distance: float) -> npt.NDArray[np.float32]:
    """Return the planar depth of a plane at a distance; ``inf`` where no ray meets it."""
    facing = RAYS @ -normal
    with np.errstate(divide="ignore"):
        depth = np.where(facing > 0.0, distance / facing, np.inf) * RAYS[..., 2]
    return depth.astype(np.float32)


def test_ids_have_colours_of_their_own_and_none_is_black() -> None:
    colours = palette()
    assert len({tuple(colour) for colour in colours.tolist()}) == 256
    assert colours[[0, 1, 2, 4, 8]].tolist() == [
        [0, 0, 0],
        [128, 0, 0],
        [0, 128, 0],
        [0, 0, 128],
        [64, 0, 0],
    ]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (ImageType.DEPTH_PLANAR, 4.0),
        (ImageType.DEPTH_VIS, 0.04),
        (ImageType.DISPARITY, 0.125 / 4.0),
    ],
)
def test_numbers_of_depth(kind: ImageType, expected: float) -> None:
    depth = np.full((12, 16), 4.0, np.float32)
    found = as_numbers(kind, seen(depth))
    assert found.dtype == np.float32
    assert found == pytest.approx(np.full((12, 16), expected))
    grey = min(round(expected * 255), 255)
    assert (as_colours(kind, seen(depth)) == grey).all()


def test_perspective_depth_is_measured_along_the_ray() -> None:
    found = as_numbers(ImageType.DEPTH_PERSPECTIVE, seen(np.full((12, 16), 4.0, np.float32)))
    assert found[..., None] * RAYS[..., 2:] == pytest.approx(4.0, rel=1e-6)


def test_the_sky_is_far_white_and_has_neither_disparity_nor_normal() -> None:
    sky = seen(np.full((12, 16), np.inf, np.float32), numbers=np.full((12, 16), -1, np.int32))
    for kind, number in {1: SKY, 2: SKY, 3: 1.0, 4: 0.0, 5: 0.0, 6: 0.0, 7: 0.0}.items():
        found = as_numbers(ImageType(kind), sky)
        assert found == pytest.approx(np.full((12, 16), number), abs=1e-5), kind
    assert (as_colours(ImageType.DEPTH_VIS, sky) == 255).all()
    assert not as_colours(ImageType.SURFACE_NORMALS, sky).any()


def test_segmentation_shows_ids_by_colour_and_infrared_by_grey() -> None:
    numbers = np.zeros((12, 16), np.int32)
    numbers[0], numbers[1] = 2, -1
    image = seen(numbers=numbers)
    assert (as_colours(ImageType.SEGMENTATION, image)[2:] == palette()[7]).all()
    assert as_colours(ImageType.INFRARED, image)[:3, 0].tolist() == [[255] * 3, [0] * 3, [7] * 3]
    assert as_numbers(ImageType.INFRARED, image)[0] == pytest.approx(np.ones(16))


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(0.05, 100.0))
def test_a_plane_has_one_normal(tilt: float, turn: float, distance: float) -> None:
    normal = -np.array([math.sin(turn), math.cos(turn) * math.sin(tilt), math.cos(turn)])
    normal[2] *= math.cos(tilt)
    depth = plane(normal, distance)
    whole = np.isfinite(depth)
    whole &= cv2.erode(whole.astype(np.uint8), np.ones((5, 5)), borderValue=1) > 0
    found = surface_normals(depth, INFO)[whole]
    assert np.abs(found - normal).max(initial=0.0) < 1e-3


def test_at_a_crease_each_pixel_has_the_normal_of_its_own_surface() -> None:
    floor, wall = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    below, ahead = plane(floor, 1.5), plane(wall, 4.0)
    found = surface_normals(np.minimum(below, ahead), INFO)
    expected = np.where((below < ahead)[..., None], floor, wall)
    assert found == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 5), (5, 1), (2, 2)])
def test_the_smallest_images_have_normals_too(width: int, height: int) -> None:
    info = CameraInfo.from_fov(width, height, 1.0)
    found = surface_normals(np.full((height, width), 3.0, np.float32), info)
    assert found == pytest.approx(np.broadcast_to([0.0, 0.0, -1.0], (height, width, 3)))


def test_normals_are_coloured_by_their_axes_in_the_map() -> None:
    toward = seen(np.full((12, 16), 3.0, np.float32))
    ahead_is_north = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    colours = as_colours(ImageType.SURFACE_NORMALS, toward._replace(turn=ahead_is_north))
    assert (colours == [0, 128, 128]).all()


@pytest.mark.parametrize("form", ["rgb", "bgr", "png", "float"])
def test_an_image_can_be_unpacked(form: Form) -> None:
    colours = np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8)
    found = packed(ImageType.SCENE, seen(colours=colours), form)
    if form == "float":
        (reply,) = wire.Decoder().feed(b"\x94\x01\x00\xc0" + found.tobytes())
        assert isinstance(reply, wire.Reply)
        assert reply.result == pytest.approx(colours[..., 0].ravel() / 255.0)
        return
    if form == "png":
        image = cv2.imdecode(found, cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert (image[..., 3] == 255).all()
        bgr = image[..., :3]
    else:
        bgr = found.reshape(12, 16, 3)
    assert np.array_equal(bgr, colours if form == "rgb" else colours[..., ::-1])
