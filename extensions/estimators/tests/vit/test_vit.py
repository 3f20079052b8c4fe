"""Libraries with the VIT interface: what they are told, in which order, and what they answer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from events import CameraAnnouncement, Event, Image, PoseEstimate, TrackingLost, TrackingRegained
from extensions.estimators.tests.vit.library import stub_settings
from runtime.errors import NodeError, VisnavError
from runtime.testing import run_nodes, spec
from tests.nodes.estimators.conformance import Case, Record, run
from tests.nodes.estimators.flight import announcements, fly
from visnav_estimators.vit import Vit, patience_left

FLIGHT = "sss fff ffff fffff"
READS = ("grey", "imu")


def case(words: str = "", eyes: int = 2, **more: Any) -> Case:
    """Return a short flight of the stub, which does what the words say."""
    hold = {"initialise": 1.0, "max_wait": 5.0, "on_missing": "lost", "lost_allowed": 1000}
    settings = {**stub_settings(words), "hold": hold, "patience": 0.05}
    mode = "stereo_inertial" if eyes == 2 else "monocular_inertial"
    return Case(Vit, settings | {"mode": mode} | more, script=FLIGHT, width=64)


def fly_stub(given: Case) -> Record:
    """Fly with images that nobody looks at."""
    said = given.announced()
    return run(given, fly(said.reads, said.eyes, given.width, given.script))


def poses(record: Record) -> list[PoseEstimate]:
    return record.of(PoseEstimate)


@pytest.mark.parametrize("eyes", [1, 2])
def test_samples_come_before_images_and_each_image_gets_its_pose(eyes: int, tmp_path: Path) -> None:
    """The stub refuses any other order; it answers from its IMU, some time after the image."""
    record = fly_stub(case("delay 2", eyes))
    estimates = poses(record)
    assert [estimate.stamp for estimate in estimates] == [*record.flight.kinds]
    assert {estimate.frame_id for estimate in estimates} == {"map"}
    for pose, heard in zip(estimates, record.heard_at, strict=True):
        assert heard - pose.stamp == 15_000_000
        truth = record.flight.truth[pose.stamp]
        assert math.dist(pose.position, truth[:3, 3]) < 0.02
        assert pose.velocity is not None
    speed = estimates[-1].velocity
    assert speed is not None
    before, now = (record.flight.truth[estimate.stamp][:3, 3] for estimate in estimates[-2:])
    for axis in range(3):
        mean = (now - before)[axis] / 0.05
        assert speed[axis] == pytest.approx(mean, abs=0.05)


def told(folder: Path, calibration: str, lens: tuple[str, tuple[float, ...]] | None = None) -> str:
    """Return what the stub was told by the interface."""
    words = f"log {folder / 'told'}"
    if calibration == "basalt":
        words += " reads $VISNAV_FOLDER/calibration.json"
    given = case(words, calibration=calibration)
    flight = fly(READS, 2, given.width, "s")
    events: list[Event] = announcements(READS, 2, given.width, lens=lens)
    rest = [event for event in flight.events if event.stamp > 0]
    run(given, flight._replace(events=(*events, *rest)))
    return (folder / "told").read_text()


def test_the_calibration_is_passed_by_the_interface(tmp_path: Path) -> None:
    lines = told(tmp_path, "interface").splitlines()
    assert lines[0] == "camera 64 48 20 38.1361 38.1361 31.5 23.5 model 0 at 0.1 0 0"
    assert lines[1] == lines[0].replace("at 0.1 0 0", "at 0.1 0.12 0")
    assert lines[2:] == ["imu 200 0.00017 1.9e-05 0.002 0.003 1", "destroyed"]


@pytest.mark.parametrize(
    ("model", "distortion", "said"),
    [
        ("equidistant", (0.1, 0.0, 0.0, 0.0), "model 4 0.1 0 0 0 at"),
        ("plumb_bob", (0.1, 0.2, 0.003, 0.004, 0.5), "model 3 0.1 0.2 0.003 0.004 0.5 0 0 0 48."),
    ],
)
def test_lenses_are_passed_in_the_words_that_libraries_know(
    model: str, distortion: tuple[float, ...], said: str, tmp_path: Path
) -> None:
    assert said in told(tmp_path, "interface", (model, distortion))


@pytest.mark.parametrize("calibration", ["basalt", "config"])
def test_or_by_files_or_not_at_all(calibration: str, tmp_path: Path) -> None:
    assert told(tmp_path, calibration) == "destroyed\n"


def test_before_the_first_pose_nothing_is_owed(tmp_path: Path) -> None:
    record = fly_stub(case("starts 5 delay 1"))
    assert [estimate.stamp for estimate in poses(record)] == [*record.flight.kinds][5:]
    assert {estimate.frame_id for estimate in poses(record)} == {"odom"}  # it had taken off by then
    assert not record.of(TrackingLost)


@pytest.mark.slow
def test_what_comes_after_its_patience_is_told(tmp_path: Path) -> None:
    given = case("delay 120")
    result = run_nodes(
        [spec(given.node, "est", given.settings)],
        inputs=fly(READS, 2, given.width, given.script).events,
        duration=1.0,
    )
    assert result.of(PoseEstimate)
    assert [*result.outside["est"].why_not] == ["its first answer came too late to be held for"]


def test_an_image_without_a_pose_is_lost_by_the_policy_of_the_hold(tmp_path: Path) -> None:
    hold = {"initialise": 1.0, "max_wait": 0.3, "on_missing": "lost", "lost_allowed": 9}
    record = fly_stub(case("skips 8", hold=hold))
    stamps = [*record.flight.kinds]
    assert [estimate.stamp for estimate in poses(record)] == stamps[:8] + stamps[9:]
    assert [event.stamp for event in record.of(TrackingLost)] == [stamps[8]]
    assert [event.stamp for event in record.of(TrackingRegained)] == [stamps[9]]


def test_a_pose_that_is_none_has_it_begin_anew_where_it_was(tmp_path: Path) -> None:
    record = fly_stub(case("nan 8"))
    stamps = [*record.flight.kinds]
    assert [event.stamp for event in record.of(TrackingLost)] == [stamps[8]]
    before, after = (next(e for e in poses(record) if e.stamp == stamps[k]) for k in (7, 9))
    assert before.position == pytest.approx(after.position)


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("skips 4", r"expected an answer to the frame of 0\.25.* s within 0\.3 s"),
        ("stops 4", r"expected a tracker that runs, found one that does not"),
        ("unknown 4", r"expected vit_tracker_create to succeed, found VIT_ERROR_INVALID_VALUE"),
    ],
)
def test_what_goes_wrong_is_one_error(words: str, error: str, tmp_path: Path) -> None:
    with pytest.raises(VisnavError, match=error):
        fly_stub(case(words, hold={"initialise": 0.1, "max_wait": 0.3}))


def test_a_library_that_crashes_is_an_error_with_its_signal(tmp_path: Path) -> None:
    with pytest.raises(NodeError, match="killed by signal 11"):
        fly_stub(case("crash 2")._replace(worker=True))


def test_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STUB_VERSION", "4")
    with pytest.raises(NodeError, match=r"expected version 1 to 3 of the VIT.*, found 4\.0\.1"):
        fly_stub(case())


def test_the_third_version_has_the_same_structures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STUB_VERSION", "3")
    record = fly_stub(case("delay 2"))
    assert len(poses(record)) == len(record.flight.kinds)


def test_patience_is_paid_once_and_not_for_every_image() -> None:
    """With 5 s of it, 67 images without a pose (at 20 Hz) cost 12 s and not 5.5 minutes."""
    now = 0.0
    for number in range(67):
        now += patience_left(5.0, number / 20, now)
    assert now == pytest.approx(5.0 + 66 * 0.1)
    assert patience_left(5.0, 1.0, 60.0) == 0.1  # whoever is late already gets some, too
    assert patience_left(0.05, 1.0, 60.0) == 0.05


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"library": "none.so"}, r"library: expected a file, found none at 'none\.so'"),
        ({"library": __file__}, "expected a library with the VIT interface, found .*invalid ELF"),
        ({"config": "none.toml"}, r"config: expected a file, found none at 'none\.toml'"),
    ],
)
def test_a_missing_library_is_an_error(settings: dict[str, Any], error: str) -> None:
    with pytest.raises(VisnavError, match=error):
        fly_stub(case(**settings))


@pytest.mark.parametrize("offset", [0.0, 0.012])
def test_images_are_on_the_clock_of_the_imu_for_the_library(offset: float) -> None:
    """What is stamped late is paired with the samples of when it was exposed, and answered."""
    given = case()
    sent: list[Event] = []
    for event in fly(READS, 2, given.width, given.script).events:
        if isinstance(event, CameraAnnouncement):
            sent.append(replace(event, time_offset=offset))
        elif isinstance(event, Image):
            sent.append(replace(event, stamp=event.stamp + round(offset * 1e9)))
        else:
            sent.append(event)
    sent.sort(key=lambda event: (event.stamp, isinstance(event, Image)))
    record = run(given, fly(READS, 2, given.width, given.script)._replace(events=tuple(sent)))
    stamps = [estimate.stamp for estimate in poses(record)]
    assert stamps == [*record.flight.kinds][: len(stamps)]
    assert len(stamps) >= 14  # for the last one the IMU has ended too early
    for pose in poses(record):
        assert math.dist(pose.position, record.flight.truth[pose.stamp][:3, 3]) < 0.02


def test_images_that_are_stamped_early_are_refused() -> None:
    said = announcements(READS, 2)
    early = [
        replace(e, time_offset=-0.01) if isinstance(e, CameraAnnouncement) else e for e in said
    ]
    with pytest.raises(
        NodeError, match="drone/left: expected a time_offset of at least 0 s, found"
    ):
        run_nodes([spec(Vit, "est", case().settings)], inputs=early)


def test_a_calibration_that_a_format_has_no_word_for_is_refused(tmp_path: Path) -> None:
    given = case(calibration="openvins")
    lens = "rational_polynomial", (0.1, 0.2, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1)
    events = announcements(READS, 2, lens=lens)
    assert isinstance(events[1], CameraAnnouncement)
    with pytest.raises(NodeError, match=r"calibration: drone/left: openvins has no word for its"):
        run_nodes([spec(given.node, "est", given.settings)], inputs=events)
