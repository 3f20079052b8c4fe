"""The newest image of a camera, from the run to a JPEG."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from events import TrackedFeatures
from runtime.errors import VisnavError
from runtime.run.supervisor import Supervisor
from runtime.tools.monitor.observer import Observer
from runtime.tools.monitor.server import IMAGE_PERIOD, MAX_SIDE, ResultCache, small_jpeg
from tests.runtime.tools.monitor.test_observer import observe

CAMERA = "drone.images: drone/front"


def decoded(jpeg: bytes) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ((120, 90, 3), (120, 90)),
        ((MAX_SIDE, MAX_SIDE), (MAX_SIDE, MAX_SIDE)),
        ((600, 1200, 3), (MAX_SIDE // 2, MAX_SIDE)),
        ((5000, 2), (MAX_SIDE, 1)),
    ],
)
def test_an_image_becomes_a_small_jpeg_of_the_same_shape(
    shape: tuple[int, ...], size: tuple[int, int]
) -> None:
    pixels = decoded(small_jpeg(np.full(shape, 90, np.uint8)))
    assert pixels.shape == size + shape[2:]
    assert np.all(np.abs(pixels.astype(int) - 90) < 3)


def test_red_stays_red() -> None:
    red = np.zeros((32, 32, 3), np.uint8)
    red[..., 0] = 250
    blue_green_red = decoded(small_jpeg(red))[16, 16]
    assert blue_green_red[2] > 240
    assert blue_green_red[0] < 10


def test_features_are_drawn_where_they_are_in_the_small_image() -> None:
    points = np.array([[300.0, 600.0], [900.0, 200.0]], np.float32)
    features = TrackedFeatures(
        stamp=0, source="vo", frame_id="front", points=points, inliers=np.array([True, False])
    )
    grey = np.zeros((800, 2 * MAX_SIDE), np.uint8)
    pixels = decoded(small_jpeg(grey, [features])).astype(int)  # half as large
    inlier, outlier = pixels[296:305, 146:155].sum((0, 1)), pixels[96:105, 446:455].sum((0, 1))
    assert inlier[1] > 2 * inlier[2]  # green
    assert outlier[2] > 2 * outlier[1]  # red
    assert pixels.sum() < 1.5 * (inlier + outlier).sum()
    assert not grey.any()  # what others have is as it was


def test_images_are_made_no_oftener_than_said(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("runtime.tools.monitor.server.time.monotonic", lambda: now)
    made: list[str] = []

    def make(name: str) -> bytes:
        made.append(name)
        return name.encode()

    kept = ResultCache()
    assert {kept.get("a", IMAGE_PERIOD, lambda: make("a")) for _ in range(5)} == {b"a"}
    kept.get("b", IMAGE_PERIOD, lambda: make("b"))
    now += IMAGE_PERIOD
    kept.get("a", IMAGE_PERIOD, lambda: make("a"))
    assert made == ["a", "b", "a"]
    assert IMAGE_PERIOD >= 0.5


def test_the_newest_image_is_known_while_somebody_looks() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.25)
        assert observer.snapshot().cameras == []
        with pytest.raises(VisnavError, match="expected a camera that has sent images, found"):
            observer.image(CAMERA)
        observer.begin()
        for newest in (0.3, 0.4):
            await supervisor.state.clock.sleep(0.1)
            assert observer.snapshot().cameras == [CAMERA]
            assert observer.image(CAMERA)[0].stamp == round(newest * 1e9)
        with pytest.raises(VisnavError, match=f"did you mean {CAMERA!r}"):
            observer.image("drone.images: drone/frond")
        observer.end()
        assert observer.snapshot().cameras == []

    observe(script)
