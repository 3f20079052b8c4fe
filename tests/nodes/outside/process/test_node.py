"""A program as an estimator: whatever it does, what it is sent stays the same."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from events import PoseEstimate, TrajectoryEstimate
from nodes.judging.evaluation import Evaluation
from nodes.ros2.bridge import Ros2Bridge
from runtime import Node, NodeConfig, on
from runtime.config.reading import load
from runtime.errors import ConfigError, VisnavError
from runtime.summary import Summary
from runtime.testing import spec
from runtime.tools.preflight import of_nodes
from tests.nodes.outside.process.rig import ROOT, STUB, AsWorker, fly, program
from tests.nodes.outside.process.test_program import alive, gone_soon
from tests.runtime.ports import free_port

pytestmark = pytest.mark.timeout(120)

FRAMES = 15
"""Of half a second."""

BEHAVIOURS: dict[str, tuple[list[str], dict[str, Any], dict[str, Any]]] = {
    # what it does: modes, settings, and what is counted besides 15 answers and estimates
    "answers": ([], {}, {}),
    "slowly": (["slow=0.03"], {}, {}),
    "floods": (["flood"], {}, {}),
    "logs": (["logs=100000"], {"hold": {"max_wait": 8.0}}, {}),
    "is deaf": (["deaf"], {}, {}),
    "out of order": (["reversed"], {"latency": 0.05}, {"estimates": 14}),
    "leaves out": (["skips=done"], {}, {"estimates": 5, "answered": 5, "empty": 10}),
    "skips": (["skips=silent"], {"latency": 0.12, "hold": {"skips": "allowed"}}, {"estimates": 4}),
    "initialises": (["starts=4"], {}, {"estimates": 11, "answered": 11, "initialising": 4}),
    "loses track": (["loses"], {}, {"estimates": 12, "says_lost": 3}),
}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    """The run of a program that answers everything."""
    return fly(program(), tmp_path_factory.mktemp("plain"))


def quick(known: Iterable[str], *names: str) -> list[Any]:
    """Return parameters of which all but these are slow."""
    return [name if name in names else pytest.param(name, marks=pytest.mark.slow) for name in known]


@pytest.mark.slow
@pytest.mark.parametrize("behaviour", quick(BEHAVIOURS, "out of order", "skips", "loses track"))
def test_what_it_is_sent_depends_on_nothing_that_it_does(
    behaviour: str, plain: Summary, tmp_path: Path
) -> None:
    modes, settings, counted = BEHAVIOURS[behaviour]
    summary = fly(program(*modes, **settings), tmp_path)
    outside = summary.outside["slam"]
    assert summary.outputs["slam.estimates"] == counted.pop("estimates", FRAMES)
    assert outside.inputs == plain.outside["slam"].inputs
    assert outside.reproducible
    assert (outside.lost, outside.unknown) == (0, 0)
    if "latency" in settings:  # what is on its way at the end may be answered or not
        return
    for name, value in ({"answered": FRAMES, "empty": 0, "open": 0} | counted).items():
        assert (name, getattr(outside, name)) == (name, value)
    if not counted:
        assert ("loses" in modes) == (summary.digest != plain.digest)


@pytest.mark.slow
def test_one_that_contradicts_itself_gets_the_same_but_is_not_called_reproducible(
    plain: Summary, tmp_path: Path
) -> None:
    summary = fly(program("twice"), tmp_path)
    outside = summary.outside["slam"]
    assert outside.inputs == plain.outside["slam"].inputs
    assert (
        outside.contradicting >= FRAMES - 2
    )  # the first does not, the last may come when the run has ended
    assert outside.why_not == ["frames were answered twice, differently"]
    assert summary.not_deterministic == ["slam"]
    log = (tmp_path / "log.txt").read_text()
    assert log.count("slam: expected one answer to the frame of 0.033333 s, found a second") == 1


@pytest.mark.slow
def test_as_a_worker_it_gives_the_same_estimates_at_the_same_times(
    plain: Summary, tmp_path: Path
) -> None:
    worker = fly(spec(AsWorker, "slam", {"latency": 0.015}), tmp_path)
    for output in ("slam.estimates", "slam.features"):
        assert worker.digests[output] == plain.digests[output]


class Ear(Node[NodeConfig]):
    """Keeps what is estimated."""

    poses: ClassVar[list[PoseEstimate]] = []
    trajectories: ClassVar[list[TrajectoryEstimate]] = []

    @on(PoseEstimate)
    def estimates(self, event: PoseEstimate) -> None:
        self.poses.append(event)

    @on(TrajectoryEstimate)
    def corrected(self, event: TrajectoryEstimate) -> None:
        self.trajectories.append(event)


@pytest.mark.slow
def test_covariance_and_velocity_reach_the_estimates_turned_as_the_poses_are(
    tmp_path: Path,
) -> None:
    """They are the body's, in the program's frame, whose x is the map's y."""
    Ear.poses.clear()
    fly(program("sure"), tmp_path, 0.2, others=(spec(Ear, "ear"),))
    assert len(Ear.poses) == 6
    for number, pose in enumerate(Ear.poses):
        assert pose.position == pytest.approx((1.0, 2.0, -0.1 + number))
        assert pose.velocity == pytest.approx((0.2, -0.1, 0.3))
        expected = np.diag([2.0, 1, 3, 5, 4, 6]) * 1e-4
        assert np.reshape(pose.covariance, (6, 6)) == pytest.approx(expected, abs=1e-15)


def corrected(out: Path, correction: str, **settings: Any) -> list[TrajectoryEstimate]:
    """Return the final trajectories of a program that promises one."""
    Ear.poses.clear()
    Ear.trajectories.clear()
    eyes = {"time_offset": settings.pop("time_offset", 0.0)}
    fly(program(f"corrects={correction}", **settings), out, 0.2, others=(spec(Ear, "ear"),), **eyes)
    return Ear.trajectories


def test_its_final_trajectory_has_stamps_and_frame_of_its_poses(tmp_path: Path) -> None:
    """Of all frames that it got, a metre ahead and each a metre further to the right."""
    (final,) = corrected(tmp_path, "well", time_offset=0.004, latency=0.001)
    assert final.frame_id == "map"
    assert final.stamps.tolist() == [pose.stamp for pose in Ear.poses]
    assert len(final.stamps) == 6
    expected = [[2.0, 2.0 + n, -0.1] for n in range(6)]
    assert final.positions == pytest.approx(np.array(expected), abs=1e-12)


def test_frames_that_wait_for_a_slow_program_are_in_its_trajectory(tmp_path: Path) -> None:
    """Answers to the last three are due after the end of the run."""
    (final,) = corrected(tmp_path, "well", latency=0.1)
    assert len(Ear.poses) < 6
    assert len(final.stamps) == 6


def test_a_trajectory_alone_starts_where_the_vehicle_was_then(tmp_path: Path) -> None:
    (final,) = corrected(
        tmp_path, "well", command=[sys.executable, STUB, "corrects=well", "starts=99"]
    )
    assert Ear.poses == []
    assert final.positions[:2].tolist() == [[1.0, 2.0, -0.1], [1.0, 3.0, -0.1]]


NO_TRAJECTORY = {
    "never": r"expected its trajectory, found it said goodbye; .* ended",
    "empty": r"expected its trajectory, found an empty one",
    "elsewhere": r"TRAJECTORY\.stamp: expected stamps of frames, found 33333338 \(1 of 2 are",
}


@pytest.mark.parametrize(
    ("correction", "policy"),
    [("never", "error"), ("never", "continue"), ("empty", "continue"), ("elsewhere", "error")],
)
def test_a_promised_trajectory_that_does_not_come_ends_in_an_error_or_a_warning(
    correction: str, policy: str, tmp_path: Path
) -> None:
    missing = NO_TRAJECTORY[correction]
    with pytest.raises(VisnavError, match=missing) if policy == "error" else nullcontext():
        assert corrected(tmp_path, correction, hold={"on_missing": policy}) == []
    assert re.search(missing, (tmp_path / "log.txt").read_text())


@pytest.mark.slow
def test_a_program_finds_no_truth_before_the_end_and_then_it_is_there(tmp_path: Path) -> None:
    out = tmp_path / "runs" / "one"
    fly(program("spies"), out, 0.2, others=(spec(Evaluation, "evaluation"),), truth=True)
    assert (out / "log.txt").read_text().count("spied: nothing") == 6
    assert len((out / "trajectories" / "truth.tum").read_text().splitlines()) == 1 + 6


@pytest.mark.slow
def test_what_a_program_costs_is_measured_from_outside(plain: Summary, tmp_path: Path) -> None:
    """By a shell that starts it, too: what counts is all that was started."""
    shell = f"{sys.executable} {STUB} burns=0.02; true"
    summary = fly(program(command=["sh", "-c", shell]), tmp_path)
    costs = summary.workers["slam"]
    assert costs.calls == FRAMES
    assert costs.cpu_p50_ms >= 19.0
    assert costs.cpu_p50_ms > 2.0 * plain.workers["slam"].cpu_p50_ms
    assert costs.wall_p50_ms >= 19.0
    assert costs.processes >= 2
    assert costs.peak_rss_mb is not None
    assert costs.peak_rss_mb > 5.0
    assert costs.latency_ms == pytest.approx(15.0)


@pytest.mark.slow
def test_with_both_cores_busy_it_is_the_same(plain: Summary, tmp_path: Path) -> None:
    over = threading.Event()
    busy = [threading.Thread(target=lambda: [None for _ in iter(over.is_set, True)]) for _ in "ab"]
    for process in busy:
        process.start()
    try:
        assert fly(program("slow=0.01"), tmp_path).digest == plain.digest
    finally:
        over.set()


GOES_WRONG: dict[str, tuple[list[str], dict[str, Any], str]] = {
    "dies": (["dies=5"], {}, r"ended with exit code 7; its last output:\nbegan dies\nout of feat"),
    "hangs": (
        ["hangs=5"],
        {"hold": {"max_wait": 0.3}},
        r"slam: expected an answer to the frame of 0\.\d+ s within 0.3 s \(max_wait\), found none",
    ),
    "nan": (
        ["nan"],
        {},
        r"POSE\.pose: expected finite numbers, found nan; .*python.* (still runs|ended)",
    ),
    "future": (["future"], {}, r"stamp: expected .*, found 1\d{9}; .*python.* (still runs|ended)"),
    "does not connect": (
        [],
        {"timeout": 1.0, "command": ["sh", "-c", "echo loading; sleep 600"]},
        r"link\.socket: expected a program.* none.*; sh still runs; its last output:\nloading",
    ),
    "ends at once": (
        ["early"],
        {},
        r"it has not connected; .* exit code 1; its last output:\nbegan early\nno voc",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", quick(GOES_WRONG, "dies", "nan", "ends at once"))
def test_what_goes_wrong_is_one_error_that_says_all(what: str, tmp_path: Path) -> None:
    modes, settings, message = GOES_WRONG[what]
    with pytest.raises(VisnavError, match=message) as caught:
        fly(program(*modes, **settings), tmp_path)
    assert str(caught.value).startswith("slam: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "lost", "reproducible", "passed"),
    [("lost", FRAMES - 5, True, False), ("continue", FRAMES - 5, False, False)],
)
def test_without_it_a_run_goes_on_if_it_may(
    policy: str, lost: int, reproducible: bool, passed: bool, tmp_path: Path
) -> None:
    begin = time.monotonic()
    summary = fly(program("dies=5", hold={"on_missing": policy, "max_wait": 60}), tmp_path)
    assert time.monotonic() - begin < 30  # and not a minute for each frame
    outside = summary.outside["slam"]
    assert (outside.answered, outside.lost) == (5, lost)
    assert outside.reproducible == reproducible
    assert summary.verdict is not None
    assert summary.verdict.passed == passed
    assert "ended with exit code 7" in (tmp_path / "log.txt").read_text()


@pytest.mark.slow
def test_what_is_on_its_way_at_the_end_is_not_lost(tmp_path: Path) -> None:
    """The program ends when it is told to, with answers to come; and its exit code is looked at."""
    hold = {"on_missing": "lost"}
    summary = fly(program("fails", latency=0.12, hold=hold), tmp_path)
    assert summary.outside["slam"].lost == 0
    assert summary.verdict is None or summary.verdict.passed
    assert "ended with exit code 3; its last output:\nbegan fails\nno disk" in (
        tmp_path / "log.txt"
    ).read_text().replace("\n    | ", "\n")


class Heard(logging.Handler):
    """When, in real time, the log said what."""

    def __init__(self) -> None:
        super().__init__()
        self.said: list[tuple[float, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append((record.created, record.getMessage()))

    def when(self, what: str) -> float:
        return next(created for created, text in self.said if what in text)


@pytest.mark.slow
@pytest.mark.parametrize("policy", quick(["error", "lost", "continue", "restart"], "error"))
def test_a_program_that_is_killed_is_missed_within_a_second(policy: str, tmp_path: Path) -> None:
    heard = Heard()
    hold = {"on_missing": policy if policy != "restart" else "error", "max_wait": 60}
    node = program("killed", on_error="restart" if policy == "restart" else "stop", hold=hold)
    with (
        pytest.raises(VisnavError, match="killed by signal 9")
        if policy == "error"
        else nullcontext()
    ):
        fly(node, tmp_path, 1.0, handlers=[heard])
    killed = float((tmp_path / "programs" / "slam" / "when").read_text())
    assert heard.when("killed by signal 9") - killed < 1.0
    assert ("restarts in 0.5 s" in str(heard.said)) == (policy == "restart")


@pytest.mark.slow
def test_one_that_died_is_started_again_and_begins_anew(tmp_path: Path) -> None:
    first, second = (
        fly(program("dies=5", on_error="restart"), tmp_path / name, 1.5) for name in "ab"
    )
    assert first.outputs["slam.estimates"] > 20
    assert first.outputs["slam.tracking_events"] == 2
    assert first.digest == second.digest
    assert first.outside["slam"].inputs == second.outside["slam"].inputs


@pytest.mark.slow
@pytest.mark.parametrize("mode", quick(["deaf", "plain"], "deaf"))
def test_no_child_of_it_stays(mode: str, tmp_path: Path) -> None:
    file = tmp_path / "pid"
    fly(program(f"daemon={file}", mode), tmp_path / "out", 0.1)
    assert gone_soon(int(file.read_text()))


@pytest.mark.slow
def test_several_cameras_come_together_and_what_is_incomplete_is_left_out(tmp_path: Path) -> None:
    eyes: dict[str, Any] = {"cameras": ("left", "right"), "images": ("grey",), "leaves_out": (3, 7)}
    node = program("log", cameras=["left", "right"], images=["grey"])
    summary = fly(node, tmp_path, **eyes)
    assert summary.outside["slam"].answered == FRAMES - 2
    assert "2 exposures lacked an image" in (tmp_path / "log.txt").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cameras": ["left", "up"]}, "cameras: expected depth, rgb images of up, found none"),
        (
            {"command": ["./no"], "folder": "/"},
            "command: expected a program .* found none at //?no",
        ),
        ({"command": ["no-such-program"]}, "found none at no-such-program"),
        ({"folder": "/not/there"}, "folder: expected a folder, found none at /not/there"),
        ({"feed": "ros2"}, "feed: expected a Ros2Bridge"),
        (
            {"files": [{"path": "a", "template": "/no/where.jinja"}]},
            "where.jinja: expected a templ",
        ),
        ({"hold": {"skips": "allowed"}}, "hold.skips: expected a latency above the camera"),
        ({"grace": 30.0}, r"grace: expected at most 10 s \(run.shutdown_limit\), found 30 s"),
    ],
)
def test_what_is_missing_is_found_before_the_run(
    settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(VisnavError, match=message):
        fly(program(**settings), tmp_path, cameras=("left", "right"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"feed": "ros2", "command": []}, "command: expected one"),
        ({"images": ["rgb", "rgb"]}, "images: expected each once"),
        ({"images": []}, "images"),
        ({"files": [{"path": "../a", "template": "b"}]}, "path: expected one below"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        program(**settings)


def test_a_template_gets_what_was_announced(tmp_path: Path) -> None:
    template = tmp_path / "settings.jinja"
    template.write_text(
        "{% for c in cameras %}{{ c.source }} {{ c.info.fx | real }} {{ c.in_imu[0] | row }}\n"
        "{% endfor %}{{ imu.rate }} {{ imu.source }} {{ vehicle.source }} "
        "{{ topic('image', cameras[0].source) }} {{ topic('imu', imu.source) }} {{ socket }}\n"
    )
    words = ["sh", "-c", 'cat "$0" >&2; exit 9', "$VISNAV_FOLDER/in/settings"]
    files = [{"path": "in/settings", "template": str(template)}]
    with tempfile.TemporaryDirectory() as short:  # enough for a socket's path
        with pytest.raises(VisnavError, match="exit code 9"):
            fly(program(command=words, files=files), Path(short) / "out")
        folder = Path(short) / "out" / "programs" / "slam"
        text = (folder / "in" / "settings").read_text()
    assert text == (
        "drone/camera 4.000000000000001 [0.0, 0.0, 1.0, 0.2]\n"
        f"200.0 drone/imu drone /drone/camera/image_raw /drone/imu {folder / 'link.socket'}\n"
    )


CHECKED = """
[[nodes]]
name = "drone"
type = "Multirotor"
[[nodes.cameras]]
name = "camera"
[[nodes]]
name = "slam"
type = "Process"
folder = "mine"
build = ["touch", "built"]
command = ["./made_by_the_build"]
[[nodes.files]]
path = "settings.yaml"
template = "mine/settings.jinja"
"""


def test_a_check_finds_what_is_wrong_beside_the_file_and_starts_nothing(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "run.toml").write_text(CHECKED)
    (tmp_path / "mine" / "settings.jinja").write_text("{{ cameras[0].rate }} {{ vehicle.mass }}")
    assert of_nodes(load(tmp_path / "run.toml")).errors == []
    (tmp_path / "mine" / "settings.jinja").write_text("{{ cameras[1].rate }}")
    (error,) = of_nodes(load(tmp_path / "run.toml", ["slam.build=['no-make']"])).errors
    assert "build: expected a program that can be executed, found none at no-make" in error
    assert f"{tmp_path / 'mine' / 'settings.jinja'}: " in error
    assert not (tmp_path / "mine" / "built").exists()
    assert not (tmp_path / "programs").exists()


def test_variables_stand_in_commands_and_a_shell_keeps_its_own(tmp_path: Path) -> None:
    words = ["sh", "-c", "echo $OMP_NUM_THREADS ${VISNAV_FOLDER} $NOT_SET. $$; exit 9"]
    folder = tmp_path / "programs" / "slam"
    with pytest.raises(VisnavError, match=rf"exit code 9; its last output:\n1 {folder} \. \d+$"):
        fly(program(command=words), tmp_path)


@pytest.mark.slow
def test_a_mistake_in_a_template_is_told_with_its_line(tmp_path: Path) -> None:
    template = tmp_path / "settings.jinja"
    for text, message in (("a\n{{ camera.fx }}", "'camera' is undefined"), ("{% if %}", "line 1")):
        template.write_text(text)
        files = [{"path": "settings", "template": str(template)}]
        with pytest.raises(VisnavError, match=f"settings.jinja: .*{message}"):
            fly(program(files=files), tmp_path / "out")


@pytest.mark.slow
def test_a_build_comes_first_and_its_failure_ends_the_run(tmp_path: Path) -> None:
    made = tmp_path / "made"
    summary = fly(program(build=["touch", str(made)]), tmp_path / "out", 0.1)
    assert summary.outside["slam"].answered == 3
    assert made.exists()
    with pytest.raises(VisnavError, match=r"slam: build: sh -c .* exit code 2; .*\nno compiler"):
        fly(program(build=["sh", "-c", "echo no compiler; exit 2"]), tmp_path / "out")


@pytest.mark.slow
def test_what_an_earlier_run_has_left_is_not_there_any_more(tmp_path: Path) -> None:
    folder = tmp_path / "programs" / "slam"
    fly(program(), tmp_path, 0.1)
    (folder / "map.bin").touch()
    fly(program(), tmp_path, 0.1)
    assert [*folder.iterdir()] == []


@pytest.mark.slow
def test_a_path_that_is_too_long_for_a_socket_is_no_hindrance(tmp_path: Path) -> None:
    out = tmp_path / ("x" * 120)
    assert fly(program(), out, 0.1).outside["slam"].answered == 3


@pytest.mark.slow
def test_in_real_time_it_gets_what_it_has_room_for(tmp_path: Path) -> None:
    summary = fly(program("slow=0.15"), tmp_path, 2.0, clock="real")
    outside = summary.outside["slam"]
    assert outside.skipped > 10
    assert outside.answered < 20
    assert outside.answered + outside.skipped + outside.open == outside.sent
    assert (
        "frames were not sent: the program was gone or had no room"
        in (tmp_path / "log.txt").read_text()
    )


@pytest.mark.slow
def test_one_that_is_started_by_hand_may_go_and_come_back(tmp_path: Path) -> None:
    pids: list[int] = []

    def start_by_hand() -> None:
        socket = tmp_path / "programs" / "slam" / "link.socket"
        environment = {
            **os.environ,
            "VISNAV_SOCKET": str(socket),
            "VISNAV_FOLDER": str(tmp_path),
            "PYTHONPATH": str(ROOT / "nodes" / "outside" / "native"),
        }
        for _ in range(2):
            while not socket.exists():
                time.sleep(0.01)  # until the run listens
            child = subprocess.Popen([sys.executable, STUB, "dies=3"], env=environment)
            pids.append(child.pid)
            child.wait()

    thread = threading.Thread(target=start_by_hand)
    thread.start()
    hold = {"on_missing": "lost", "max_wait": 60}
    summary = fly(program(command=[], hold=hold), tmp_path, 10.0, clock="real")
    thread.join(30)
    outside = summary.outside["slam"]
    assert outside.answered > 10
    assert outside.lost > 0
    assert not any(alive(pid) for pid in pids)


@pytest.mark.slow
def test_one_that_a_bridge_feeds_is_told_where_and_its_end_is_the_bridges_to_judge(
    tmp_path: Path,
) -> None:
    port = free_port()
    words = ["sh", "-c", "env | grep -E 'ROS_|RMW|ZENOH'; exit 4"]
    held = {
        "topic": "/slam/pose",
        "type": "geometry_msgs/msg/PoseStamped",
        "as": "estimate",
        "source": "poses",
        "answers_to": "drone/camera",
        "latency": 0.015,
        "timeout": 0.5,
        "hold": {"on_missing": "lost"},
    }
    settings: dict[str, Any] = {"connect": [], "listen": [f"tcp/127.0.0.1:{port}"], "domain_id": 7}
    bridge = spec(Ros2Bridge, "ros2", settings)
    with pytest.raises(VisnavError, match="slam: sh ended with exit code 4; its last output:") as e:
        fly(program(feed="ros2", command=words), tmp_path, 60.0, others=(bridge,), clock="real")
    for expected in (
        "ROS_DOMAIN_ID=7",
        "RMW_IMPLEMENTATION=rmw_zenoh_cpp",
        f'ZENOH_CONFIG_OVERRIDE=connect/endpoints=["tcp/127.0.0.1:{port}"]',
    ):
        assert expected in str(e.value)
    bridge = spec(Ros2Bridge, "ros2", settings | {"subscriptions": [held]})
    with pytest.raises(VisnavError, match="ros2: "):  # that nobody publishes poses
        fly(program(feed="ros2", command=words), tmp_path, 60.0, others=(bridge,))
    assert "sh ended with exit code 4" in (tmp_path / "log.txt").read_text()
