"""`check` on whole files: mistakes that a colleague would see are one line each."""

from __future__ import annotations

from pathlib import Path

import pytest

from events import Collision, Event, Image, Odometry
from runtime import Input, Node, NodeConfig, on
from runtime.extras import why_missing
from runtime.paths import OutputPath
from runtime.tools.cli.inspect import example_files
from tests.runtime.tools.samples_cli import ROOT, command_here

ROOM = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <geom name="north" type="box" size=".1 5 2" pos="5 0 2"/>
  <geom name="south" type="box" size=".1 5 2" pos="-5 0 2"/>
  <geom name="east" type="box" size="5 .1 2" pos="0 -5 2"/>
  <geom name="west" type="box" size="5 .1 2" pos="0 5 2"/>
  <geom name="ceiling" type="box" size="5 5 .1" pos="0 0 4"/>
  <geom name="pillar" type="cylinder" size=".5 2" pos="2 0 2"/>
  <geom name="curtain" type="box" size=".1 4 2" pos="-2 0 2" contype="0" conaffinity="0"/>
</worldbody></mujoco>
"""
FILE = """
[run]
name = "check"
[[nodes]]
name = "drone"
type = "Multirotor"
world = "room.xml"
[[nodes.cameras]]
name = "front"
[[nodes.cameras]]
name = "down"
images = ["grey"]
[[nodes]]
name = "pilot"
type = "WaypointFollower"
waypoints = [[0, 0, -1], [-3, 0, -1], [-3, 3, -1]]
[[nodes]]
name = "odometry"
type = "VisualOdometry"
[[nodes]]
name = "log"
type = "tests.runs.test_check:Log"
"""


class LogConfig(NodeConfig):
    """Settings of files in the run's folder."""

    trajectory: OutputPath = "trajectory.tum"
    plot: OutputPath = "flight.png"


class Log(Node[LogConfig]):
    """A node that writes files."""

    @on(Odometry, Image, Collision)
    def seen(self, event: Event) -> None:
        """Take what a log would."""


class Zero(Node):
    """A node that ticks at no rate."""

    async def on_startup(self) -> None:
        self.every(0, lambda _: None)


class Narrow(Node):
    """A node that means an input that it has not."""

    images = Input(Image)

    async def on_startup(self) -> None:
        self.narrow("imgs", "drone/front")

    async def run(self) -> None:
        async for _ in self.images:
            pass


@pytest.fixture
def room(tmp_path: Path) -> Path:
    (tmp_path / "room.xml").write_text(ROOM)
    path = tmp_path / "room.toml"
    path.write_text(FILE)
    return path


def check(path: Path, *changes: str) -> tuple[int, list[str]]:
    words = [word for change in changes for word in ("--set", change)]
    done = command_here("check", path, *words, folder=path.parent)
    return done.returncode, [*done.stderr.splitlines(), *done.stdout.splitlines()]


def test_a_right_file_is_right_from_anywhere(room: Path) -> None:
    for folder in (room.parent, ROOT):
        done = command_here("check", room, folder=folder)
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.endswith("4 nodes, 10 connections: right\n")
    assert sorted(path.name for path in room.parent.iterdir()) == ["room.toml", "room.xml"]


TYPE = "tests.runs.test_check:Log"
MISTAKES = [
    ("drone.world=none.xml", "drone: world: ", "none.xml: expected an MJCF file, found nothing"),
    ("drone.world=hal", "drone: world: ", 'found "hal"; did you mean hall?'),
    ("down.name=front", "(drone): cameras: front: expected a name of its own", "found two"),
    ('front.images=["rgb"]', "odometry: expected a camera with depth", "drone/front, drone/down"),
    ('odometry.inputs={frames="drone/frnt"}', "inputs.frames: expected one of", "'drone/front'"),
    ('odometry.inputs={frames="drone/down"}', "odometry: cannot work with drone/down", "depth"),
    ("drone.position=[9.0,0.0]", "drone: position: expected ground", "[9, 0, -0.1]: outside"),
    ("drone.position=[2.0,0.0]", "drone: position: expected a free place", "in pillar"),
    ("drone.height=-1", "drone: position: expected a free place", "in the ground (floor)"),
    ("pilot.waypoints=[[0,0,1.5]]", "waypoints[0]: expected a free", "heights are negative"),
    ("pilot.waypoints=[[0,0,-1],[9,0,-1]]", "waypoints[1]: expected a free way", "found pillar"),
    ("pilot.waypoints=[[-9,0,-1]]", "waypoints[0]: expected a free way", "found south between"),
    ("pilot.waypoints=[[0,0,-9]]", "waypoints[0]", "ceiling"),
    ("pilot.waypoints=[[2,0,-1]]", "waypoints[0]: expected a free place", "in pillar"),
    ("front.latency=40", "cameras[0].latency: expected a unit", 'did you mean "40ms"'),
    ("odometry.latency=15", "latency: expected a unit", 'did you mean "15ms"'),
    ("log.plot=trajectory.tum", "log: expected files of its own", ""),
    ("log.plot=summary.json", "log: expected files of its own", "summary.json, which the run"),
    ('pilot.inputs={odometry="dron"}', "pilot: inputs.odometry: expected one of drone", "'drone'"),
    ("log.type=tests.runs.test_check:Zero", "log: every: expected a rate above 0", "found 0"),
    ("log.type=tests.runs.test_check:Narrow", "narrow: expected one of images", "'imgs'"),
    ("run.duration=-3s", "run.duration: expected a duration that is not neg", 'found "-3s"'),
    ("run.duration=40 msec", 'found "40 msec", of no known', 'unit (did you mean "40ms"?)'),
    ("log.name=pilot", "nodes[3].name: expected a name that no other node has", '"pilot"'),
    ("log.plt=x.png", "nodes[3] (log): found unknown key", "'plt' (did you mean 'plot'?)"),
]


@pytest.mark.parametrize(("change", "expected", "rest"), MISTAKES, ids=lambda text: str(text)[:40])
def test_each_mistake_is_one_line(room: Path, change: str, expected: str, rest: str) -> None:
    if change.startswith("log.plot=trajectory"):
        room.write_text(f'{room.read_text()}\n[[nodes]]\nname="more"\ntype="{TYPE}"\n')
        change, expected = "log.plot=more.png", "more: expected files of its own"
    code, lines = check(room, change)
    errors = [line for line in lines if line.startswith("error: ")]
    assert code == 2
    assert errors == [line for line in lines if not line.startswith("warning: ")]
    assert len(errors) == 1 or "more" in expected
    assert expected in errors[0]
    assert rest in errors[0]


def test_a_library_that_its_system_lacks_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "torn_library.py").write_text("raise ImportError('libGL.so.1: cannot open')")
    assert why_missing("torn_library") == "No module named 'torn_library'"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert why_missing("torn_library") == "ImportError: libGL.so.1: cannot open"
    assert why_missing("json") == ""


PILOT = '[[nodes]]\nname = "p"\ntype = "WaypointFollower"\nwaypoints = [[0, 0, -1]]\n'
JUDGE = '[[nodes]]\nname = "e"\ntype = "Evaluation"\n'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (PILOT, "p: expected a vehicle to fly, found none: add one, such as a Multirotor"),
        (JUDGE + "thresholds = { ate_percent = 1.0 }", "e: thresholds: expected an estimator to"),
    ],
)
def test_what_a_node_cannot_do_without_is_an_error(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "f.toml").write_text(text)
    code, lines = check(tmp_path / "f.toml")
    assert (code, len(lines)) == (2, 1)
    assert lines[0].startswith(f"error: f.toml: {told}")


def test_a_vehicle_that_starts_in_the_air_is_odd(room: Path) -> None:
    code, lines = check(room, "drone.height=1")
    assert code == 0
    assert lines[0] == "warning: drone: position, height: it starts 1 m above the ground, and falls"


def test_a_recording_is_looked_for_beside_the_file(tmp_path: Path) -> None:
    path = tmp_path / "again.toml"
    path.write_text('[[nodes]]\nname = "r"\ntype = "Replay"\nfile = "flight.mcap"\n')
    code, lines = check(path)
    file = tmp_path / "flight.mcap"
    assert code == 2
    assert lines == [
        f"error: again.toml: r: {file}: expected a recording or the folder of a data set, found "
        "nothing there; docs/how-to/datasets.md says where to download those of EuRoC, TUM and "
        "KITTI",
    ]


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    "path",
    example_files().values(),
    ids=lambda path: path.stem,
)
def test_our_own_files_are_right(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that need a recording, a vocabulary or a server say so and nothing else."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # as on a machine on which nothing has run
    code, lines = check(path)
    if code:
        needy = {"replay", "orb_slam3", "plain", "euroc", "tum", "kitti", "svo", "evalio"}
        assert path.stem in needy
        causes = "expected a recording", "expected a vocabulary", "pip install"
        assert all(any(cause in line for cause in causes) for line in lines)
    else:
        assert lines[-1].endswith(": right")
        warnings = [line for line in lines if line.startswith("warning: ")]
        if path.stem == "airsim_client":
            assert "is known to the server only: not all can be checked" in warnings[0]
        assert len(warnings) == (3 if path.stem == "airsim_client" else 0), warnings
        assert not [line for line in lines if line.startswith("error: ")]
