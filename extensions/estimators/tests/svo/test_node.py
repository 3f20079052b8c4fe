"""The node around SVO, and its process, with a stub in the place of the library."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

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
from extensions.estimators.tests.svo.stub.svo_cpp import SE3d
from runtime.errors import ConfigError, MissingDependencyError, NodeError
from runtime.testing import run_node
from visnav_estimators.svo import Svo, SvoProcess, SvoSettings, _matrix, _threads, _wait_for

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


@pytest.mark.slow
def test_it_says_where_the_body_went_and_when_it_was_lost() -> None:
    inputs = [camera(PINHOLE), *images(0, 9, 9, 9, 0, 9, 9)]
    result = run_node(Svo, inputs=inputs, duration=0.6, name="svo")
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.method, said.scale_free, said.lenses) == ("SVO", True, ())
    estimates = result.of(PoseEstimate)
    assert [estimate.stamp // FRAME for estimate in estimates] == [3, 4, 6, 7]
    assert {estimate.frame_id for estimate in estimates} == {"odom"}
    np.testing.assert_allclose(estimates[1].position, (0.0, 0.2, 0.0), atol=1e-12)  # right
    assert [event.stamp // FRAME for event in result.of(TrackingLost)] == [5]
    assert [event.stamp // FRAME for event in result.of(TrackingRegained)] == [6]


@pytest.mark.slow
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


INFO = CameraInfo.from_fov(8, 6, 1.5)
GREY = np.full((6, 8), 100, np.uint8)
BLACK = np.zeros_like(GREY)
PERIOD = 100_000_000


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(STUB))
    monkeypatch.delitem(sys.modules, "svo_cpp", raising=False)
    import svo_cpp  # the stub

    yield svo_cpp
    del sys.modules["svo_cpp"]


def track(svo: SvoProcess, images: list[npt.NDArray[np.uint8]], first: int = 0) -> list[Any]:
    return [svo.track((first + k) * PERIOD, image) for k, image in enumerate(images)]


def test_nothing_is_said_before_there_is_a_map_and_then_poses_in_the_first_frame(
    library: Any,
) -> None:
    results = track(SvoProcess(INFO, SvoSettings()), [GREY] * 4)
    assert results[0] is None
    assert [result.lost for result in results[1:]] == [False] * 3
    x = [result.pose[:3, 3].tolist() for result in results[1:]]
    np.testing.assert_allclose(x, [[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]], atol=1e-12)
    turned = Rotation.from_matrix(results[-1].pose[:3, :3]).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, -0.03], atol=1e-12)


def test_it_is_started_again_when_it_stops_for_want_of_corners(library: Any) -> None:
    svo = SvoProcess(INFO, SvoSettings())
    assert track(svo, [BLACK] * 5) == [None] * 5
    assert [result is None for result in track(svo, [GREY] * 3, first=5)] == [True, False, False]


def test_a_relocalizing_one_is_lost_and_keeps_its_last_pose(library: Any) -> None:
    results = track(SvoProcess(INFO, SvoSettings()), [GREY] * 3 + [BLACK] * 2 + [GREY])
    assert [result.lost for result in results[1:]] == [False, False, True, True, False]
    assert "nearest key frame" in results[3].reason
    np.testing.assert_array_equal(results[4].pose, results[2].pose)
    assert "reset" not in library.CALLS


def test_after_its_time_a_new_map_goes_on_from_the_last_pose(library: Any) -> None:
    svo = SvoProcess(INFO, SvoSettings(reset_timeout=0.25))
    before = track(svo, [GREY] * 4)[-1]
    lost = track(svo, [BLACK] * 6, first=4)
    assert all(result.lost for result in lost)
    assert library.CALLS.count("reset") == 1
    after = track(svo, [GREY] * 3, first=10)
    assert [result.lost for result in after] == [True, False, False]
    assert "where the camera was last known to be" in after[1].reason
    assert (after[2].reason, after[2].map) == ("", 1)
    step = np.linalg.inv(before.pose) @ after[1].pose
    np.testing.assert_allclose(step[:3, 3], [0.1, 0, 0], atol=1e-12)


def test_a_pose_that_is_no_number_is_never_said(
    library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    svo = SvoProcess(INFO, SvoSettings())
    track(svo, [GREY] * 3)
    bad = library.Frame(1)
    bad.T_f_w = SE3d.of(Rotation.identity(), np.full(3, np.nan))
    monkeypatch.setattr(library.SVO, "lastFrame", lambda self: bad)
    result = svo.track(3 * PERIOD, GREY)
    assert result is not None
    assert result.lost
    assert np.isfinite(result.pose).all()


def test_settings_reach_the_library_by_its_own_names(library: Any) -> None:
    SvoProcess(INFO, SvoSettings(features=77, keyframe_distance=0.2))
    assert library.CONFIG["max_fts"] == 77
    assert library.CONFIG["kfselect_mindist"] == 0.2


def test_a_coloured_image_becomes_grey_and_one_of_another_size_is_refused(library: Any) -> None:
    svo = SvoProcess(INFO, SvoSettings())
    track(svo, [np.full((6, 8, 3), 9, np.uint8)] * 2)
    with pytest.raises(ValueError, match=r"expected \(6, 8\) pixels, found \(8, 6\)"):
        svo.track(9 * PERIOD, np.zeros((8, 6), np.uint8))


def test_a_missing_library_is_an_error_with_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "svo_cpp", None)
    with pytest.raises(MissingDependencyError, match="pip install --no-deps 'svo-cpp"):
        SvoProcess(INFO, SvoSettings())


numbers = st.floats(-1e3, 1e3)


@pytest.mark.slow
@given(st.tuples(numbers, numbers, numbers), st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_pose_is_read_from_where_it_lies(
    shift: tuple[float, float, float], turn: tuple[float, float, float]
) -> None:
    rotation = Rotation.from_rotvec(turn)
    matrix = _matrix(SE3d.of(rotation, np.array(shift)))
    np.testing.assert_allclose(matrix[:3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[:3, 3], shift)


def test_another_layout_is_an_error_and_no_wrong_pose() -> None:
    class Swapped(SE3d):
        def inverse(self) -> SE3d:  # as if the quaternion were w, x, y, z
            x, y, z, w = self.quaternion
            back = Rotation.from_quat([y, z, w, x]).inv()
            return SE3d.of(back, -back.apply(np.array(self.shift)))

    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    pose = Swapped.of(turn, np.array([1.0, 2.0, 3.0]))
    with pytest.raises(RuntimeError, match=r"svo_cpp's poses as in release 1\.5"):
        _matrix(pose)


def test_it_waits_until_other_threads_have_no_more_work() -> None:
    before, begin, end = _threads(), threading.Event(), threading.Event()
    done = []

    def work() -> None:
        begin.wait()
        done.append(sum(range(3_000_000)))
        end.wait()

    worker = threading.Thread(target=work)
    worker.start()
    try:
        own = _threads() - before
        assert len(own) == 1
        assert str(os.getpid()) not in own
        begin.set()
        while worker.is_alive() and not done:
            _wait_for(own)  # Python's lock makes it sleep in between, as no thread of C++ does
        _wait_for(own)
        assert done
    finally:
        end.set()
        worker.join()
