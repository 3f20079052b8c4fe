"""The node around SVO, with a stub in the place of the library."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    CameraInfo,
    EstimatorAnnouncement,
    Event,
    Image,
    PoseEstimate,
    TrackingLost,
    TrackingRegained,
)
from nodes.estimators.svo import Svo
from runtime.errors import ConfigError, NodeError
from runtime.testing import run_node

STUB = Path(__file__).parent / "stub"
FRAME = 50_000_000


def camera(info: CameraInfo) -> Event:
    return CameraAnnouncement(
        stamp=0,
        source="drone/down",
        images=("grey",),
        info=info,
        rate=20.0,
        latency=0.0,
        frame_id="down_optical",
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=(0.5**0.5, 0.0, 0.0, 0.5**0.5),
    )


def images(*greys: int) -> list[Event]:
    return [
        Image(
            stamp=(number + 1) * FRAME,
            source="drone/down",
            frame_id="down_optical",
            encoding="mono8",
            data=np.full((6, 8), grey, np.uint8),
        )
        for number, grey in enumerate(greys)
    ]


PINHOLE = CameraInfo.from_fov(8, 6, 1.5)


@pytest.fixture(autouse=True)
def stub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(STUB))  # which a worker takes over


def test_it_says_where_the_body_went_and_when_it_was_lost() -> None:
    inputs = [camera(PINHOLE), *images(0, 9, 9, 9, 0, 9, 9)]
    result = run_node(Svo, inputs=inputs, duration=0.6, name="svo")
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.method, said.scale_free, said.lenses) == ("SVO", True, ())
    estimates = result.of(PoseEstimate)
    assert [each.stamp // FRAME for each in estimates] == [3, 4, 6, 7]
    assert {each.frame_id for each in estimates} == {"odom"}
    np.testing.assert_allclose(estimates[1].position, (0.0, 0.2, 0.0), atol=1e-12)  # right
    assert [each.stamp // FRAME for each in result.of(TrackingLost)] == [5]
    assert [each.stamp // FRAME for each in result.of(TrackingRegained)] == [6]


def test_a_library_that_ends_its_process_is_a_clear_error() -> None:
    with pytest.raises(NodeError, match=r"worker .*(ended|died)"):
        run_node(Svo, inputs=[camera(PINHOLE), *images(9, 9, 255)], duration=0.5)


def test_a_lens_with_distortion_is_refused_if_it_is_not_rectified() -> None:
    bent = CameraInfo(
        width=8, height=6, fx=8, fy=8, cx=4, cy=3, distortion=(-0.3, 0.1, 0.0, 0.0, 0.0)
    )
    with pytest.raises(NodeError, match="expected images without distortion"):
        run_node(Svo, inputs=[camera(bent)], config={"rectify": False})


@pytest.mark.parametrize(
    "settings", [{"grid_size": 1}, {"features": 0}, {"keyframe_distance": 0.0}, {"levels": 9}]
)
def test_settings_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        run_node(Svo, config={"svo": settings})
