"""Images and clouds: the bytes are rosbags' own, and come back as they were."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from events import DepthImage, Image, LidarScan, PointCloud
from nodes.ros2.messages import incoming, outgoing
from nodes.ros2.messages.images import ImageWriter, depth_pixels, image_pixels
from nodes.ros2.messages.incoming import MessageContext
from nodes.ros2.messages.outgoing import Outgoing
from nodes.ros2.messages.topics import PublishingConfig
from nodes.ros2.messages.typestore import Stamps
from tests.nodes.ros2.messages import samples

CONTEXT = MessageContext(source="s", now=1_000_000_002)
IMAGE = "sensor_msgs/msg/Image"
RANDOM = np.random.default_rng(0)


def out() -> Outgoing:
    return Outgoing(samples.store(), PublishingConfig(), Stamps().out)


def by_rosbags(encoding: str, data: np.ndarray, stamp: tuple[int, int], frame: str) -> bytes:
    store = samples.store()
    message = store.message(IMAGE)(
        header=store.header(stamp, frame),
        height=data.shape[0],
        width=data.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=data.nbytes // data.shape[0],
        data=np.ascontiguousarray(data).view(np.uint8).ravel(),
    )
    return bytes(store.serialize(message))


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("rgb8", RANDOM.integers(0, 256, (5, 7, 3), np.uint8)),
        ("mono8", RANDOM.integers(0, 256, (5, 7), np.uint8)),
        ("32FC1", RANDOM.random((5, 7), np.float32)),
        ("32SC1", RANDOM.integers(-1, 9, (5, 7), np.int32)),
    ],
)
@pytest.mark.parametrize("frame", ["f", "camera_optical_frame", "frames/of/every", "length"])
def test_an_image_has_the_bytes_that_rosbags_makes(
    encoding: str, data: np.ndarray, frame: str
) -> None:
    writer = ImageWriter(samples.store(), frame, encoding)
    for stamp in ((1, 2), (3, 999_999_999)):
        expected = by_rosbags(encoding, data, stamp, frame)
        assert bytes(writer.write(stamp, data)) == expected


def test_depth_in_millimetres_is_read_back_as_metres() -> None:
    metres = np.array([[0.5, np.inf, 70.0], [2.0004, 0.0, 65.535]], np.float32)
    data = ImageWriter(samples.store(), "f", "16UC1").write((1, 2), metres)
    message = samples.store().deserialize(bytes(data), IMAGE)
    assert (message.encoding, message.step, message.data.nbytes) == ("16UC1", 6, 12)
    read = depth_pixels(message)
    expected = np.array([[0.5, np.inf, np.inf], [2.0, np.inf, 65.535]])
    np.testing.assert_allclose(read, expected, rtol=1e-6)


def test_a_writer_follows_a_new_size_and_takes_views() -> None:
    writer = ImageWriter(samples.store(), "f", "rgb8")
    big = RANDOM.integers(0, 256, (8, 6, 3), np.uint8)
    for data in (big, big[::2, 1:4], big[:, ::-1]):
        assert bytes(writer.write((1, 2), data)) == by_rosbags("rgb8", data, (1, 2), "f")


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_cloud_has_the_bytes_that_rosbags_makes(count: int) -> None:
    points = RANDOM.random((count, 3), np.float32)
    colours = RANDOM.integers(0, 256, (count, 3), np.uint8)
    event = PointCloud(stamp=1, source="s", frame_id="a_optical", points=points, colors=colours)
    data = outgoing.cloud(out(), event)
    message: Any = samples.store().deserialize(bytes(data), "sensor_msgs/msg/PointCloud2")
    assert bytes(samples.store().serialize(message)) == bytes(data)
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rgb", 12, 7)
    ]  # fmt: skip
    assert (message.width, message.height, message.is_dense) == (count, 1, True)
    rows = message.data.reshape(count, 16)
    np.testing.assert_array_equal(rows[:, :12].copy().view(np.float32), points)
    packed = rows[:, 12:].copy().view(np.uint32).ravel() if count else np.zeros(0, np.uint32)
    np.testing.assert_array_equal(packed >> 16 & 255, colours[:, 0])
    np.testing.assert_array_equal(packed & 255, colours[:, 2])


def test_a_cloud_with_points_that_are_nowhere_is_not_dense() -> None:
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]], np.float32)
    none = np.empty((0, 3), np.uint8)
    data = outgoing.cloud(out(), PointCloud(stamp=1, source="s", points=points, colors=none))
    message: Any = samples.store().deserialize(bytes(data), "sensor_msgs/msg/PointCloud2")
    assert not message.is_dense


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_turn_of_a_lidar_has_the_fields_of_velodynes_driver(count: int) -> None:
    """FAST-LIO reads them with ``lidar_type: 2`` and ``timestamp_unit: 0`` (seconds)."""
    scan = LidarScan(
        stamp=1,
        source="drone/lidar",
        frame_id="a_optical",
        points=RANDOM.random((count, 3), np.float32),
        intensities=RANDOM.random(count, np.float32),
        times=np.sort(RANDOM.random(count, np.float32)),
        rings=RANDOM.integers(0, 16, count, np.uint16),
    )
    data = outgoing.lidar(out(), scan)
    message: Any = samples.store().deserialize(bytes(data), "sensor_msgs/msg/PointCloud2")
    assert bytes(samples.store().serialize(message)) == bytes(data)
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7),
        ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7),
    ]  # fmt: skip
    rows = message.data.reshape(count, message.point_step)

    def column(begin: int, end: int, kind: type) -> np.ndarray:
        return rows[:, begin:end].copy().view(kind) if count else np.empty((0, 1), kind)

    np.testing.assert_array_equal(column(0, 12, np.float32).reshape(-1, 3), scan.points)
    np.testing.assert_array_equal(column(12, 16, np.float32).ravel(), scan.intensities)
    np.testing.assert_array_equal(column(16, 18, np.uint16).ravel(), scan.rings)
    np.testing.assert_array_equal(column(18, 22, np.float32).ravel(), scan.times)


@pytest.mark.parametrize("shape", [(48, 64, 3), (48, 64)])
def test_a_png_holds_the_image_and_names_it_as_image_transport_does(
    shape: tuple[int, ...],
) -> None:
    data = RANDOM.integers(0, 256, shape, np.uint8)
    colour = len(shape) == 3
    event = Image(
        stamp=1, source="s", frame_id="f", encoding="rgb8" if colour else "mono8", data=data
    )
    config = PublishingConfig(compressed_images="png")
    message = samples.message(outgoing.compressed_image, event, config=config)
    assert message.format == (
        "rgb8; png compressed bgr8" if colour else "mono8; png compressed mono8"
    )
    image = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    assert image is not None
    np.testing.assert_array_equal(image[..., ::-1] if colour else image, data)


def parsed(encoding: str, data: np.ndarray) -> Any:
    return samples.store().deserialize(by_rosbags(encoding, data, (1, 2), "f"), IMAGE)


def test_images_come_back_as_they_went() -> None:
    data = RANDOM.integers(0, 256, (4, 6, 3), np.uint8)
    full = np.full((4, 6, 1), 255, np.uint8)
    for encoding, pixels in (
        ("rgb8", data),
        ("bgr8", data[..., ::-1]),
        ("8UC3", data[..., ::-1]),
        ("rgba8", np.concatenate([data, full], axis=2)),
        ("bgra8", np.concatenate([data[..., ::-1], full], axis=2)),
    ):
        event: Any = incoming.image(parsed(encoding, pixels), CONTEXT)
        np.testing.assert_array_equal(event.data, data)
        assert (event.encoding, event.stamp, event.frame_id) == ("rgb8", 1_000_000_002, "f")
    grey: Any = incoming.image(parsed("mono8", data[..., 0]), CONTEXT)
    np.testing.assert_array_equal(grey.data, data[..., 0])
    assert grey.encoding == "mono8"


def test_rows_may_be_filled_up() -> None:
    message = parsed("mono8", np.arange(24, dtype=np.uint8).reshape(3, 8))
    message.width = 5
    np.testing.assert_array_equal(image_pixels(message), np.arange(24).reshape(3, 8)[:, :5])
    message = parsed("bgr8", np.arange(36, dtype=np.uint8).reshape(3, 4, 3))
    message.width = 3
    np.testing.assert_array_equal(
        image_pixels(message), np.arange(36).reshape(3, 4, 3)[:, :3, ::-1]
    )


@pytest.mark.parametrize(
    ("pattern", "colours"),
    [("rggb", "RGGB"), ("bggr", "BGGR"), ("gbrg", "GBRG"), ("grbg", "GRBG")],
)
@pytest.mark.parametrize("bits", [8, 16])
def test_a_bayer_pattern_becomes_the_colour_that_it_is_of(
    pattern: str, colours: str, bits: int
) -> None:
    """The name says the first two rows' first pixels (sensor_msgs/image_encodings.hpp)."""
    levels = {"R": 200, "G": 100, "B": 50}
    cell = np.reshape([levels[colour] for colour in colours], (2, 2))
    kind = np.uint16 if bits == 16 else np.uint8
    mosaic = (np.tile(cell, (4, 5)) * (257 if bits == 16 else 1)).astype(kind)
    image = image_pixels(parsed(f"bayer_{pattern}{bits}", mosaic))
    assert image.shape == (8, 10, 3)
    assert (image[2:-2, 2:-2] == (200, 100, 50)).all()


@pytest.mark.parametrize("big", [0, 1])
def test_of_sixteen_bits_the_high_byte_is_the_image(big: int) -> None:
    steps = np.array([[0, 255, 256], [0x1234, 0xFF00, 0xFFFF]], ">u2" if big else "<u2")
    expected = [[0, 0, 1], [0x12, 0xFF, 0xFF]]
    message = parsed("mono16", steps.view(np.uint8))
    message.width, message.is_bigendian = 3, big
    np.testing.assert_array_equal(image_pixels(message), expected)
    colours = np.repeat(steps[..., None], 3, axis=2) & np.array([0xFFFF, 0, 0], steps.dtype)
    message = parsed("bgr16", colours.astype(steps.dtype).view(np.uint8).reshape(2, -1))
    message.width, message.is_bigendian = 3, big
    blue = image_pixels(message)
    np.testing.assert_array_equal(blue[..., 2], expected)
    assert not blue[..., :2].any()


def test_a_compressed_image_of_sixteen_bits_is_grey_or_millimetres() -> None:
    steps = np.array([[0, 1500], [0x1234, 0xFFFF]], np.uint16)
    code = cv2.imencode(".png", steps)[1].ravel()
    header = SimpleNamespace(frame_id="c", stamp=SimpleNamespace(sec=1, nanosec=0))
    message = SimpleNamespace(header=header, format="16UC1; png compressed", data=code)
    grey = incoming.image(message, CONTEXT)
    assert isinstance(grey, Image)
    np.testing.assert_array_equal(grey.data, [[0, 5], [0x12, 0xFF]])
    depth = incoming.depth(message, CONTEXT)
    assert isinstance(depth, DepthImage)
    np.testing.assert_allclose(depth.data, [[np.inf, 1.5], [4.66, 65.535]])
    message.data = cv2.imencode(".png", np.zeros((2, 2, 3), np.uint8))[1].ravel()
    with pytest.raises(ValueError, match=r"expected depth in 16 bits or metres, found uint8"):
        incoming.depth(message, CONTEXT)


def test_depth_comes_in_metres_and_what_is_unknown_is_infinite() -> None:
    metres = np.array([[1.5, np.nan, np.inf], [0.0, -1.0, 2.0]], np.float32)
    image = depth_pixels(parsed("32FC1", metres))
    inf = np.inf
    np.testing.assert_array_equal(image, np.array([[1.5, inf, inf], [inf, inf, 2.0]], np.float32))
    millimetres = np.array([[1500, 0, 2]], np.uint16)
    image = depth_pixels(parsed("16UC1", millimetres))
    np.testing.assert_allclose(image, [[1.5, inf, 0.002]], rtol=1e-6)


@pytest.mark.parametrize(
    "lie",
    [
        {"height": 5},
        {"height": 3},
        {"width": 7},
        {"step": 17},
        {"height": 0, "width": 0},
        {"height": 2**32 - 1, "width": 2**32 - 1},
        {"height": 2**31, "step": 2**31},
        {"encoding": "yuv422"},
        {"encoding": "rgba8"},
    ],
)
def test_a_header_that_does_not_fit_its_data_is_refused(lie: dict[str, Any]) -> None:
    message = parsed("rgb8", np.zeros((4, 6, 3), np.uint8))
    for field, value in lie.items():
        setattr(message, field, value)
    with pytest.raises(ValueError, match="expected"):
        image_pixels(message)
    with pytest.raises(ValueError, match="expected"):
        depth_pixels(message)
