"""The newest image of a camera, from the run to a JPEG."""

from __future__ import annotations

import asyncio
import threading

import cv2
import numpy as np
import pytest

from events import Image
from runtime.errors import VisnavError
from runtime.run.supervisor import Supervisor
from runtime.tools.monitor import server as images
from runtime.tools.monitor.observer import Observer
from runtime.tools.monitor.server import MAX_SIDE, ImageEncoder, small_jpeg
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


def image(stamp: int) -> Image:
    data = np.full((16, 16), stamp, np.uint8)
    return Image(stamp=stamp, source="drone/front", frame_id="front", encoding="mono8", data=data)


async def test_images_are_encoded_in_a_thread_and_no_oftener_than_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr("runtime.tools.monitor.server.time.monotonic", lambda: now)
    threads: list[threading.Thread] = []
    encode = small_jpeg

    def noting(data: np.ndarray) -> bytes:
        threads.append(threading.current_thread())
        return encode(data)

    monkeypatch.setattr(images, "small_jpeg", noting)
    asked: list[int] = []

    async def newest() -> Image:
        asked.append(len(asked) * 50)
        return image(asked[-1])

    encoder = ImageEncoder()
    same = await asyncio.gather(*(encoder.encode("a", newest) for _ in range(5)))
    assert len(set(same)) == 1
    assert asked == [0]
    await encoder.encode("b", newest)
    assert asked == [0, 50]
    now += images.IMAGE_PERIOD
    assert decoded(await encoder.encode("a", newest)).mean() == pytest.approx(100, abs=3)
    assert len(threads) == 3
    assert threading.main_thread() not in threads


def test_the_newest_image_is_known_while_somebody_looks() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.25)
        assert observer.take().cameras == []
        with pytest.raises(VisnavError, match="expected a camera that has sent images, found"):
            observer.image(CAMERA)
        observer.begin()
        for newest in (0.3, 0.4):
            await supervisor.state.clock.sleep(0.1)
            assert observer.take().cameras == [CAMERA]
            assert observer.image(CAMERA).stamp == round(newest * 1e9)
        with pytest.raises(VisnavError, match=f"did you mean {CAMERA!r}"):
            observer.image("drone.images: drone/frond")
        observer.end()
        assert observer.take().cameras == []

    observe(script)
