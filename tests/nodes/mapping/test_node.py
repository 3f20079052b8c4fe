"""Mapping as a node: which frames it takes, where it puts them, what it leaves."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    Image,
    Odometry,
    PointCloud,
    PoseStamped,
)
from nodes.mapping import Mapping, read_ply
from runtime.errors import NodeError, RefusedError
from runtime.testing import NodeResult, run_node, run_nodes, spec

MS = 1_000_000
INFO = CameraInfo.from_fov(32, 24, 1.2)
FORWARD = (0.5, 0.5, 0.5, 0.5)
"""Optical to body, of a camera that looks ahead."""
LEVEL = (1.0, 0.0, 0.0, 0.0)


def camera(name: str = "drone/front", images: tuple[str, ...] = ("rgb", "depth")) -> Event:
    return CameraAnnouncement(
        stamp=0,
        source=name,
        images=images,
        info=INFO,
        rate=10.0,
        latency=0.0,
        frame_id=f"{name}_optical",
        parent_frame_id="base_link",
        position=(0.5, 0.0, 0.0),
        orientation=FORWARD,
    )


def exposure(
    stamp: int, north: float = 0.0, name: str = "drone/front", grey: bool = False
) -> list[Event]:
    """What a camera at some place sees of a wall 2 m ahead of it: the upper half is red."""
    data = np.zeros((24, 32, 3), np.uint8)
    data[:12, :, 0] = 200
    depth = np.full((24, 32), 2.0, np.float32)
    place = (north, 0.0, 0.0)
    frame_id = f"{name}_optical"
    image = (
        Image(stamp=stamp, source=name, frame_id=frame_id, encoding="mono8", data=data[..., 0])
        if grey
        else Image(stamp=stamp, source=name, frame_id=frame_id, data=data)
    )
    return [
        PoseStamped(stamp=stamp, source=name, position=place, orientation=FORWARD),
        DepthImage(stamp=stamp, source=name, frame_id=frame_id, data=depth),
        image,
    ]


def odometry(stamp: int, north: float, source: str = "drone") -> Odometry:
    return Odometry(
        stamp=stamp,
        source=source,
        position=(north, 0.0, 0.0),
        orientation=LEVEL,
        linear_velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
    )


class Beside:
    """Does what a worker does, without a process: starting one takes most of a second."""

    def __init__(self, node: Mapping, made: Any, latency: float) -> None:
        self._node, self._made, self._latency = node, made, latency

    async def call(self, method: Callable[..., Any], *args: Any) -> Any:
        return await self.call_for(self._latency, method, *args)

    async def call_for(self, latency: float, method: Callable[..., Any], *args: Any) -> Any:
        result = method(self._made, *args)
        await self._node.clock.sleep(latency)
        return result


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    async def worker(self: Mapping, made: Any, *args: Any, latency: float, env: Any) -> Beside:
        return Beside(self, made(*args), latency)

    monkeypatch.setattr(Mapping, "worker", worker)


def run(*events: Event, out: Path | None = None, **config: Any) -> NodeResult:
    inputs: Iterable[Event] = [camera(), *events]
    return run_node(Mapping, inputs=inputs, config=config, duration=1.0, name="m", out=out)


def planes(cloud: PointCloud) -> list[float]:
    """North of the walls in a cloud."""
    return sorted({round(float(north), 3) for north in cloud.points[:, 0]})


@pytest.mark.slow
def test_the_cloud_is_sent_and_written_at_the_end(tmp_path: Path) -> None:
    """In map, with its colours, and the same in both; frames too soon after another are left
    out, and so is what has no partner of its stamp."""
    lonely = exposure(700 * MS, north=50.0)[1:]
    result = run(
        *exposure(0),
        *exposure(60 * MS, north=7.0),
        *exposure(100 * MS, north=1.0),
        *lonely,
        out=tmp_path,
    )
    (cloud,) = result.of(PointCloud)
    assert (cloud.stamp, cloud.source, cloud.frame_id) == (100 * MS, "m", "map")
    assert planes(cloud) == [2.0, 3.0]
    red = cloud.colors[:, 0] == 200
    assert (cloud.points[red, 2] < 0).all()  # up is negative
    assert (cloud.points[~red, 2] > 0).all()
    assert (cloud.colors[:, 1:] == 0).all()
    east = cloud.points[:, 1]
    assert east.max() == pytest.approx(2.0 * INFO.cx / INFO.fx, abs=2.1 * 2.0 / INFO.fx)
    written = read_ply(tmp_path / "clouds" / "m.ply", 10_000)
    np.testing.assert_array_equal(written.points, cloud.points)
    np.testing.assert_array_equal(written.colors, cloud.colors)


@pytest.mark.usefixtures("in_process")
def test_the_latest_pose_is_the_vehicles_when_the_frame_comes(tmp_path: Path) -> None:
    """Times the camera's mounting; other vehicles' do not count, nor does what comes later."""
    events = [
        odometry(0, 0.0),
        odometry(40 * MS, 0.12),
        odometry(40 * MS, 55.0, source="other"),
        *exposure(0, north=99.0),  # comes after what is above, so at 40 ms
    ]
    result = run(*events, odometry(80 * MS, 3.0), out=tmp_path, pose="latest", file="l.ply")
    (cloud,) = result.of(PointCloud)
    assert planes(cloud) == [2.62]
    assert read_ply(tmp_path / "l.ply", 10_000).total == len(cloud.points)


@pytest.mark.usefixtures("in_process")
def test_clouds_come_at_their_rate(tmp_path: Path) -> None:
    """Growing, and without a folder there is no file."""
    frames = [e for k in range(8) for e in exposure(k * 100 * MS, north=0.5 * k)]
    result = run(*frames, rate=4.0, latency="20ms", stride=1)
    clouds = result.of(PointCloud)
    assert [c.stamp // MS for c in clouds] == [0, 300, 600, 700]
    sizes = [len(c.points) for c in clouds]
    assert sizes == sorted(sizes)
    assert sizes[0] > len(exposure(0)) > 0
    assert not (tmp_path / "clouds").exists()


@pytest.mark.usefixtures("in_process")
def test_one_camera_is_chosen_and_grey_will_do() -> None:
    """The first that gives depth and colours, or the one that the file names."""
    cameras = [
        camera("drone/blind", ("rgb",)),
        camera("drone/grey", ("grey", "depth")),
        camera("drone/front"),
    ]
    frames = [*exposure(0, 0.0, "drone/grey", grey=True), *exposure(0, 5.0)]
    clouds = []
    for inputs in ({}, {"frames": "drone/front"}):
        node = spec(Mapping, "m", inputs=inputs)
        result = run_nodes([node], inputs=[*cameras, *frames], duration=0.5)
        clouds += result.of(PointCloud)
    assert [planes(cloud) for cloud in clouds] == [[2.0], [7.0]]
    assert (clouds[0].colors[:, 0] == clouds[0].colors[:, 2]).all()


@pytest.mark.usefixtures("in_process")
def test_without_a_camera_that_will_do_there_is_an_error() -> None:
    with pytest.raises(RefusedError, match=r"expected a camera with depth and rgb .* found none"):
        run_node(Mapping, inputs=[camera(images=("rgb",))], duration=0.1)
    named = spec(Mapping, "m", inputs={"frames": "drone/front"})
    with pytest.raises(RefusedError, match=r"drone/front: expected .* found one with rgb$"):
        run_nodes([named], inputs=[camera(images=("rgb",))], duration=0.1)


@pytest.mark.usefixtures("in_process")
def test_without_a_frame_there_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "visnav.m")
    result = run(out=tmp_path)
    assert result.of(PointCloud) == []
    assert [r.getMessage() for r in caplog.records] == ["no frame came: there is no cloud"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("in_process")
def test_images_that_do_not_fit_the_announcement_are_an_error() -> None:
    pose, depth, image = exposure(0)
    assert isinstance(image, Image)
    small = Image(stamp=0, source=image.source, frame_id="", data=image.data[:10].copy())
    with pytest.raises(NodeError, match=r"image: expected \(12, 16\) pixels .* found \(5, 16\)"):
        run(pose, depth, small)
