"""ORB-SLAM3 itself, in a worker, on a known flight; poses stay in one frame while worlds change."""

from __future__ import annotations

import asyncio
import hashlib
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from extensions.estimators.tests.orb_slam3.scene import CAMERA, IMU, INFO, RIGHT, View, views
from runtime.errors import MissingDependencyError
from runtime.testing import run_in_lockstep
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.workers.worker import Worker
from visnav_estimators.orb_slam3.node import (
    Anchor,
    KeyFrame,
    OrbSlam3Process,
    OrbSlam3Result,
    check_arrays,
    first_key_frame,
    wait_for_other_threads,
)
from visnav_estimators.orb_slam3.settings import (
    Mode,
    OrbSettings,
    TreeShape,
    make_settings,
    train,
    write_vocabulary,
)
from visnav_estimators.orb_slam3.training import describe

ROOT = Path(__file__).parents[4]
Floats = npt.NDArray[np.float64]
ORB = OrbSettings(features=1200)


@pytest.fixture(scope="module")
def vocabulary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vocabulary") / "vocabulary.txt"
    tree = train([describe(v.rgb, 1000) for v in views(31)[::10]], TreeShape(depth=3))
    write_vocabulary(tree, path)
    return path


class Flight:
    """What ORB-SLAM3 said of some images, what it knew at the end, and what it printed."""

    def __init__(self, mode: Mode, vocabulary: Path, seen: Sequence[View]) -> None:
        self.tracked: list[OrbSlam3Result] = []
        self.printed: list[str] = []
        self.seen = seen
        self.stamps, self.final = np.empty(0, np.int64), np.empty((0, 4, 4))
        try:
            run_in_lockstep(self._fly(mode, vocabulary))
        except MissingDependencyError as error:
            pytest.skip(str(error))

    async def _fly(self, mode: Mode, vocabulary: Path) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        clock = LockstepClock(loop)
        settings = make_settings(mode, [CAMERA, RIGHT][: 1 + (mode == "stereo")], IMU, ORB)
        slam = Worker(
            "slam", clock, OrbSlam3Process, settings, vocabulary, printed=self.printed.append
        )
        try:
            await slam.ready()
            for view in self.seen:
                depth = view.depth if "rgbd" in mode else None
                right = view.right if mode == "stereo" else None
                said = await slam.call(OrbSlam3Process.track, view.stamp, view.rgb, depth, right)
                self.tracked.append(said)
            self.stamps, self.final, _ = await slam.call(OrbSlam3Process.trajectory)
        finally:
            await asyncio.to_thread(slam.close)
            clock.close()

    def final_errors(self) -> Floats:
        """Return metres between the trajectory after all corrections and what is so."""
        at = [[v.stamp for v in self.seen].index(stamp) for stamp in self.stamps.tolist()]
        true = np.array([self.seen[k].pose for k in at])
        assert (np.diff(self.stamps) > 0).all()
        assert not any(self.tracked[k].lost for k in at)
        return np.asarray(np.linalg.norm(self.final[:, :3, 3] - true[:, :3, 3], axis=1))

    def errors(self) -> tuple[Floats, Floats]:
        """Return metres and degrees between what was said and what is so, where it was known."""
        said = np.array([t.pose for t in self.tracked if not t.lost])
        true = np.array(
            [v.pose for t, v in zip(self.tracked, self.seen, strict=True) if not t.lost]
        )
        turn = np.swapaxes(said[:, :3, :3], 1, 2) @ true[:, :3, :3]
        degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
        return np.linalg.norm(said[:, :3, 3] - true[:, :3, 3], axis=1), degrees


@pytest.fixture(scope="module")
def flight(vocabulary: Path) -> Flight:
    return Flight("rgbd", vocabulary, views(48, blank=range(30, 36)))


@pytest.mark.slow
def test_the_pose_is_the_camera_in_its_first_frame_in_metres(flight: Flight) -> None:
    first, last = flight.tracked[0], flight.tracked[29]
    assert not any(t.lost for t in flight.tracked[:30])
    np.testing.assert_allclose(first.pose, np.eye(4), atol=1e-6)
    assert (first.first_keyframe, first.maps, first.state) == (0, 1, "OK")
    # The camera went 35 cm to the right and 23 cm ahead, and turned left by 10 degrees.
    np.testing.assert_allclose(last.pose[:3, 3], flight.seen[29].pose[:3, 3], atol=0.01)
    metres, degrees = Flight.errors(flight)
    assert metres[:30].max() < 0.01
    assert degrees[:30].max() < 0.3


@pytest.mark.slow
def test_a_blank_image_is_lost_and_the_last_pose_stays(flight: Flight) -> None:
    before, blank = flight.tracked[29], flight.tracked[30:36]
    assert all(t.lost and t.reason and t.state != "OK" for t in blank)
    assert all(t.pose.tobytes() == before.pose.tobytes() for t in blank)
    assert all(t.matches == 0 and not t.inliers.any() for t in blank)


def test_it_goes_on_when_it_sees_again(flight: Flight) -> None:
    after = flight.tracked[-1]
    assert not after.lost
    if after.maps == 1:  # it knew the place again
        assert np.linalg.norm(after.pose[:3, 3] - flight.seen[-1].pose[:3, 3]) < 0.02
    else:  # it began anew where it was last, so what it flew blindly is missing
        regained = next(k for k in range(36, 48) if not flight.tracked[k].lost)
        missing = flight.seen[29].pose @ np.linalg.inv(flight.seen[regained].pose)
        expected = missing @ flight.seen[-1].pose
        assert np.linalg.norm(after.pose[:3, 3] - expected[:3, 3]) < 0.03


def test_points_are_corners_in_the_image_and_most_agree_with_the_map(flight: Flight) -> None:
    for said in flight.tracked[1:30]:
        assert said.points.dtype == np.float32
        assert said.points.shape == (len(said.inliers), 2)
        assert (said.points >= 0).all()
        assert (said.points < (INFO.width, INFO.height)).all()
        assert 100 < said.inliers.sum() <= said.matches


def test_what_it_prints_is_gathered_by_the_worker(flight: Flight) -> None:
    assert any("ORB-SLAM3 Copyright" in line for line in flight.printed)


@pytest.mark.slow
def test_colours_are_taken_in_the_order_that_images_have(vocabulary: Path) -> None:
    [seen] = views(1)
    grey = seen._replace(rgb=np.asarray(cv2.cvtColor(seen.rgb, cv2.COLOR_RGB2GRAY)))
    swapped = seen._replace(rgb=np.ascontiguousarray(seen.rgb[:, :, ::-1]))
    corners = [Flight("rgbd", vocabulary, [v]).tracked[0].points for v in (seen, grey, swapped)]
    np.testing.assert_array_equal(corners[0], corners[1])
    assert corners[0].tobytes() != corners[2].tobytes()


def test_the_final_trajectory_is_in_the_frame_of_the_poses_that_were_said(flight: Flight) -> None:
    """Also if ORB-SLAM3 has thrown its first map away, and begun another one."""
    said = {v.stamp: t.pose for v, t in zip(flight.seen, flight.tracked, strict=True) if not t.lost}
    assert len(flight.stamps) > 5
    assert set(flight.stamps.tolist()) <= set(said)
    before = np.array([said[stamp] for stamp in flight.stamps.tolist()])
    apart = np.linalg.norm(flight.final[:, :3, 3] - before[:, :3, 3], axis=1)
    assert apart.max() < 0.02


@pytest.mark.slow
def test_two_eyes_give_poses_in_metres(vocabulary: Path) -> None:
    flight = Flight("stereo", vocabulary, views(45))
    assert not any(t.lost for t in flight.tracked)
    metres, degrees = flight.errors()
    assert metres.max() < 0.03
    assert degrees.max() < 0.8
    assert len(flight.stamps) == 45
    assert flight.final_errors().max() < 0.03


@pytest.mark.slow
def test_without_depth_the_way_is_right_but_for_its_scale(vocabulary: Path) -> None:
    flight = Flight("monocular", vocabulary, views(45))
    assert flight.tracked[0].lost
    known = [k for k, t in enumerate(flight.tracked) if not t.lost]
    assert len(known) > 25
    assert known[-1] == 44
    stamps = [v.stamp for v in flight.seen]
    began = stamps.index(flight.tracked[-1].first_keyframe)
    assert began < known[0]
    start = np.linalg.inv(flight.seen[began].pose)
    true = np.array([(start @ flight.seen[k].pose)[:3, 3] for k in known])
    said = np.array([flight.tracked[k].pose[:3, 3] for k in known])
    scale = (true * said).sum() / (said * said).sum()
    assert scale > 0
    # Before a flat wall, shape and way are weakly told apart: some centimetres of half a metre.
    assert np.linalg.norm(scale * said - true, axis=1).max() < 0.06


@pytest.mark.parametrize(
    ("mode", "arrays", "message"),
    [
        ("rgbd", ("rgb",), "depth: mode 'rgbd' expects an array, found none"),
        ("rgbd", ("rgb", "small"), r"depth: expected shape \(240, 320\), found \(10, 10\)"),
        ("monocular", ("rgb", "depth"), "depth: mode 'monocular' expects none, found an array"),
        ("monocular", ("small",), r"image: expected shape .*\(240, 320, 3\).*found \(10, 10\)"),
        ("stereo", ("rgb",), "right: mode 'stereo' expects an array, found none"),
        ("monocular_inertial", ("rgb",), "imu: mode 'monocular_inertial' expects an array"),
    ],
)
def test_what_orb_slam3_would_not_notice_is_refused(
    mode: Mode, arrays: tuple[str, ...], message: str
) -> None:
    view = views(1)[0]
    known: dict[str, Any] = {
        "rgb": view.rgb,
        "depth": view.depth,
        "small": np.zeros((10, 10), np.float32),
    }
    image, depth = [*(known[name] for name in arrays), None][:2]
    cameras = [CAMERA, RIGHT] if mode == "stereo" else [CAMERA]
    with pytest.raises(ValueError, match=message):
        check_arrays(make_settings(mode, cameras, IMU), image, depth, None, None)


def test_a_missing_library_is_an_error_that_says_what_to_install(
    vocabulary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyorbslam3", None)
    with pytest.raises(MissingDependencyError, match=r"estimators\[orbslam3\]'.*libegl1"):
        OrbSlam3Process(make_settings("rgbd", [CAMERA]), vocabulary)


def test_measurements_later_than_an_image_wait_for_the_next(
    vocabulary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of an image that was exposed before the first of all; the library refuses them."""
    given: list[list[float]] = []

    class Slam:
        def __init__(self, *_: object, **__: object) -> None: ...
        def track_rgbd(self, _: object, __: object, ___: float, chunk: np.ndarray) -> object:
            given.append(chunk[:, 0].round(3).tolist())
            return None

        def is_shutdown(self) -> bool:
            return True

    stub = SimpleNamespace(Slam=Slam, Sensor=SimpleNamespace(IMU_RGBD=0))
    monkeypatch.setitem(sys.modules, "pyorbslam3", stub)
    monkeypatch.setattr(OrbSlam3Process, "_result", lambda *_: None)
    process = OrbSlam3Process(make_settings("rgbd_inertial", [CAMERA], IMU), vocabulary, 0.0)
    [view] = views(1)
    for stamp, times in ((-1, [0.0]), (50, [10.0, 60.0]), (100, [70.0, 100.0])):
        imu = np.zeros((len(times), 7))
        imu[:, 0] = np.array(times) * 1e6
        process.track(stamp * 1_000_000, view.rgb, view.depth, None, imu)
    process.close()
    assert given == [[], [0.0, 0.01], [0.06, 0.07, 0.1]]


@pytest.mark.slow
def test_importing_the_module_does_not_import_the_library() -> None:
    """In a fresh interpreter, since other tests of this process may have used it."""
    code = "import sys, visnav_estimators.orb_slam3.node; sys.exit('pyorbslam3' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def pose(x: float, yaw: float = 0.0) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", yaw).as_matrix()
    matrix[:3, 3] = (x, 0.0, 0.0)
    return matrix


def test_the_first_key_frame_is_the_origin_wherever_the_world_is() -> None:
    anchor = Anchor()
    assert anchor.maps == 0
    upright = pose(5.0, 1.0)
    anchor.world_may_have_changed(KeyFrame(0.5, upright), upright @ pose(2.0))
    np.testing.assert_allclose(anchor.place(upright @ pose(3.0)), pose(3.0), atol=1e-12)
    assert anchor.maps == 1


def test_a_world_that_turns_takes_its_first_key_frame_along() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.5, np.eye(4)), pose(1.0))
    np.testing.assert_allclose(anchor.place(pose(1.0)), pose(1.0))
    turned = pose(-4.0, 0.7)
    anchor.world_may_have_changed(KeyFrame(0.5, turned), turned @ pose(1.1))
    np.testing.assert_allclose(anchor.place(turned @ pose(1.2)), pose(1.2), atol=1e-12)
    assert anchor.maps == 1


def test_a_pose_from_just_before_the_world_turned_is_told_by_the_old_one() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.5, np.eye(4)), pose(1.0))
    anchor.place(pose(1.0))
    turned = pose(-4.0, 0.7)
    anchor.world_may_have_changed(KeyFrame(0.5, turned), pose(1.1))
    np.testing.assert_allclose(anchor.place(pose(1.1)), pose(1.1), atol=1e-12)
    anchor.world_may_have_changed(KeyFrame(0.5, turned), turned @ pose(1.2))
    np.testing.assert_allclose(anchor.place(turned @ pose(1.2)), pose(1.2), atol=1e-12)


def test_a_small_turn_is_followed_with_the_next_pose_at_the_latest() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.5, np.eye(4)), pose(1.0))
    anchor.place(pose(1.0))
    turned = pose(0.02)
    for _ in range(2):  # the camera stands still, so the old world seems right
        anchor.world_may_have_changed(KeyFrame(0.5, turned), pose(1.0))
        anchor.place(pose(1.0))
    np.testing.assert_allclose(anchor.last, pose(0.98), atol=1e-12)


def test_a_new_map_begins_where_the_camera_was_last_and_falls_into_place_when_merged() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.0, np.eye(4)), np.eye(4))
    anchor.place(pose(2.0, 0.3))
    # Lost; a new map whose first key frame is the present one.
    anchor.world_may_have_changed(KeyFrame(7.0, np.eye(4)), np.eye(4))
    np.testing.assert_allclose(anchor.place(np.eye(4)), pose(2.0, 0.3), atol=1e-12)
    np.testing.assert_allclose(anchor.place(pose(0.5)), pose(2.0, 0.3) @ pose(0.5), atol=1e-12)
    assert (anchor.maps, anchor.map) == (2, 1)
    # Merged: the world is the first map's again, and its pose there is the truth.
    anchor.world_may_have_changed(KeyFrame(0.0, np.eye(4)), pose(3.1))
    np.testing.assert_allclose(anchor.place(pose(3.1)), pose(3.1), atol=1e-12)
    assert anchor.map == 0
    assert anchor.maps == 2


def test_a_new_map_may_begin_before_the_present_image() -> None:
    """Without depth, the first key frame is some images back."""
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.0, np.eye(4)), np.eye(4))
    anchor.place(pose(2.0))
    anchor.world_may_have_changed(KeyFrame(7.0, np.eye(4)), pose(0.4))
    np.testing.assert_allclose(anchor.place(pose(0.4)), pose(2.0), atol=1e-12)


def test_the_first_key_frame_of_a_trajectory(tmp_path: Path) -> None:
    file = tmp_path / "trajectory.tum"
    file.write_text(
        "1.500000 0.1 -0.2 3.0 0.0 0.70710678 0.0 0.70710678\n1.6 0 0 0 0 0 0 1\n",
        encoding="ascii",
    )
    first = first_key_frame(file)
    assert first is not None
    assert first.stamp == 1.5
    np.testing.assert_allclose(first.pose[:3, 3], (0.1, -0.2, 3.0))
    np.testing.assert_allclose(
        first.pose[:3, :3], Rotation.from_euler("y", 90, degrees=True).as_matrix(), atol=1e-7
    )
    file.write_text("")
    assert first_key_frame(file) is None


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "in_time"), [(60.0, True), (0.05, False)])
def test_other_threads_are_waited_for_until_they_rest_or_have_had_their_time(
    limit: float, in_time: bool
) -> None:
    computed, ended = threading.Event(), threading.Event()

    def compute() -> None:
        block = bytes(1 << 20)
        for _ in range(600):  # some tenths of a second, without the interpreter's lock
            hashlib.sha256(block).digest()
        computed.set()
        while not ended.wait(0.005):  # looks for more to do, as ORB-SLAM3's threads
            pass

    thread = threading.Thread(target=compute)
    thread.start()
    wait_for_other_threads(time.process_time() + limit)
    in_the_end = computed.is_set()
    ended.set()
    thread.join()
    assert in_the_end == in_time
