"""The suite: which runs it makes, and what its page says of those that fail."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import visnav
from runtime.config.overrides import override
from runtime.errors import CommandError, ConfigError
from runtime.tools.suite.page import cells, flights, write_page
from runtime.tools.suite.plan import FOLDER, LEVELS, Entrant, Scenario, Suite, make_plan, read_suite
from runtime.tools.sweep.tables import Row, crashed
from tests.runtime.tools.samples_cli import command

SMALL = """
rig = "rig.toml"
thresholds = { ate_percent = 1.0, coverage_percent = 90.0 }

[[scenarios]]
name = "slow"
level = "easy"
shows = "a short flight"

[[scenarios]]
name = "quick"
level = "brutal"
shows = "another one"
set = ["pilot.speed=2"]

[[estimators]]
name = "good"
reads = "truth"
node = { type = "SyntheticOdometry", drift = 0.5 }

[[estimators]]
name = "bad"
reads = "truth"
node = { type = "SyntheticOdometry", drift = 9.0 }

[[estimators]]
name = "elsewhere"
reads = "nothing"
module = "a_module_that_is_not_there"
install = "make elsewhere"
node = { type = "SyntheticOdometry" }
"""

RIG = """
[run]
name = "rig"
duration = "20s"

[[nodes]]
name = "drone"
type = "Multirotor"

[[nodes]]
name = "pilot"
type = "WaypointFollower"
start_delay = "0s"
waypoints = [[0.0, 0.0, -1.0], [1.0, 0.0, -1.0]]
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    (tmp_path / "suite.toml").write_text(SMALL, encoding="utf-8")
    return tmp_path / "suite.toml"


@pytest.mark.slow
def test_the_projects_own_suite_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """All settings exist, scenarios rise from easy to brutal, and all share their flights."""
    suite = read_suite()
    monkeypatch.setattr(Entrant, "installed", lambda *_: True)
    plan = make_plan(suite, out=Path("out"), seeds=3, repeats=2)
    flown = suite.flown()
    assert [s.name for s in flown if s.calibration == "exact"] == ["hall", "evening_exact"]
    assert len(plan.jobs) == (3 * len(flown) + 1) * len(suite.estimators)
    assert len({job.flight for job in plan.jobs}) == 3 * len(flown)
    levels = [LEVELS.index(scenario.level) for scenario in suite.scenarios]
    assert levels == sorted(levels)
    assert {*levels} == {*range(len(LEVELS))}
    assert (FOLDER / "rig.toml").is_file()


def test_runs_of_one_flight_follow_each_other(small: Path) -> None:
    plan = make_plan(read_suite(small), out=Path("out"), seeds=2, repeats=2)
    order = [(dict(j.settings)["scenario"], j.seed) for j in plan.jobs]
    assert order == sorted(order, key=lambda run: (run[0] != "slow", run[1]))
    assert len({job.id for job in plan.jobs}) == len(plan.jobs) == 10
    twice = [(dict(j.settings)["scenario"], j.seed) for j in plan.jobs if j.repeat == 2]
    assert twice == [("slow", 1)] * 2
    assert {dict(j.settings)["estimator"] for j in plan.jobs} == {"good", "bad"}


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("drift = 0.5", "drfit = 0.5", r"drfit"),
        ('"pilot.speed=2"', '"pliot.speed=2"', r"pliot"),
        ('level = "easy"', 'level = "nice"', r"suite\.toml: Invalid enum value 'nice'"),
        ('rig = "rig.toml"', 'rig = "no.toml"', r"no\.toml: expected a TOML file of a rig"),
        ('rig = "rig.toml"', "rig = ", r"suite\.toml: Invalid value"),
    ],
)
def test_what_is_wrong_in_a_suite_is_named(
    small: Path, before: str, after: str, expected: str
) -> None:
    small.write_text(SMALL.replace(before, after), encoding="utf-8")
    with pytest.raises(ConfigError, match=expected):
        make_plan(read_suite(small), out=Path("out"))


def test_a_part_of_it_is_chosen_by_name(small: Path) -> None:
    part = read_suite(small).only(["quick"], ["good", "elsewhere"])
    assert [s.name for s in part.scenarios] == ["quick"]
    assert [e.name for e in part.estimators] == ["good", "elsewhere"]
    with pytest.raises(CommandError, match=r"--scenario: expected one of slow, quick, found quik"):
        read_suite(small).only(["quik"], [])


def test_a_scenario_may_have_another_vehicle(small: Path) -> None:
    rig = RIG.replace('name = "drone"', 'name = "other"')
    (small.parent / "other.toml").write_text(rig, encoding="utf-8")
    own = 'level = "easy"\nrig = "other.toml"'
    small.write_text(SMALL.replace('level = "easy"', own, 1), encoding="utf-8")
    jobs = make_plan(read_suite(small), out=Path("out")).jobs
    vehicles = {dict(j.settings)["scenario"]: '"other"' in j.text for j in jobs}
    assert sorted(vehicles.values()) == [False, True]
    small.write_text(small.read_text().replace("other.toml", "none.toml"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"none\.toml: expected a TOML file of a rig"):
        make_plan(read_suite(small), out=Path("out"))


def test_paths_in_a_scenario_start_at_the_suites_folder(small: Path) -> None:
    small.write_text(SMALL.replace("pilot.speed=2", "drone.world=rooms/room.xml"), encoding="utf-8")
    texts = [job.text for job in make_plan(read_suite(small), out=Path("out")).jobs]
    assert any(f'world = "{small.parent}/rooms/room.xml"' in text for text in texts)


def page_of(suite: Suite, tmp_path: Path, change: Any) -> str:
    """Return the page of rows of which one estimator's are changed."""
    plan = make_plan(suite, out=tmp_path / "out", seeds=2, repeats=2)
    rows: list[Row] = []
    for job in plan.jobs:
        name = dict(job.settings)["estimator"]
        row = crashed(job, "")
        figures = {"flight_ate_percent": 0.5 * job.seed, "coverage_percent": 100.0}
        digest = f"{name}{job.seed}" + f"-{job.repeat}" * (name == "bad")
        row |= {"passed": True, "estimators": {name: {"passed": True, **figures}}}
        row |= {"digests": {name: digest}}
        rows.append(change(row) if name == "bad" else row)
    write_page(suite, plan, rows, tmp_path / "SUITE.md", "runtime suite")
    return (tmp_path / "SUITE.md").read_text(encoding="utf-8")


def line_of(page: str, name: str) -> str:
    """Return the line of an estimator in the table of all."""
    return next(line for line in page.splitlines() if line.startswith(f"| {name} |"))


@pytest.mark.slow
def test_who_fails_is_shown_as_such(small: Path, tmp_path: Path) -> None:
    """A missed threshold, a crash and silence: in the table of all, and in that of the scenario."""

    def missed(row: Row) -> Row:
        row["estimators"]["bad"] |= {"flight_ate_percent": 40.0, "failed": ["lost: for 9 s"]}
        row["estimators"]["bad"] |= {"passed": False}
        return row | {"passed": False}

    def crashed(row: Row) -> Row:
        return row | {"passed": None, "estimators": {}, "error": "its worker died"}

    def once(row: Row) -> Row:
        return crashed(row) if row["seed"] == 2 else row

    suite = read_suite(small)
    page = page_of(suite, tmp_path, missed)
    assert line_of(page, "good") == "| good | truth | yes | 0.75 (0.5 to 1) | 0.75 (0.5 to 1) |"
    assert line_of(page, "bad") == "| bad | truth | no, differs | 40 **failed** | 40 **failed** |"
    assert page.count("- bad: lost: for 9 s\n") == 2
    page = page_of(suite, tmp_path, crashed)
    assert line_of(page, "bad") == "| bad | truth | unknown | **failed** | **failed** |"
    assert page.count("- bad: its worker died") == 2
    page = page_of(suite, tmp_path, once)
    assert "**failed** 1 of 2" in line_of(page, "bad")


def both(path: Path) -> Suite:
    """Return the small suite, whose quick scenario is flown with and without an error."""
    text = SMALL.replace("set =", 'calibration = "both"\nset =')
    errors = 'calibration_errors = ["drone.imu.calibration_error=true"]\n'
    path.write_text(text.replace("\n[[", f"{errors}\n[[", 1), encoding="utf-8")
    return read_suite(path)


def test_calibrations_err_in_all_scenarios_that_do_not_say_exact(small: Path) -> None:
    plan = make_plan(both(small), out=Path("out"), seeds=2, repeats=1)
    errs = {}
    for job in plan.jobs:
        (drone,) = (n for n in tomllib.loads(job.text)["nodes"] if n["name"] == "drone")
        errs[dict(job.settings)["scenario"], job.seed] = drone["imu"]["calibration_error"]
    names = ("slow", True), ("quick", True), ("quick_exact", False)
    assert errs == {(name, seed): wrong for name, wrong in names for seed in (1, 2)}


@pytest.mark.slow
def test_a_column_says_what_an_exact_calibration_was_worth(small: Path, tmp_path: Path) -> None:
    """The median over the seeds of errors divided by those of the same seed's exact flight."""
    suite = both(small)
    plan = make_plan(suite, out=tmp_path / "out", seeds=3, repeats=1)
    rows: list[Row] = []
    for job in plan.jobs:
        scenario, name = (text for _, text in job.settings)
        error = 0.1 if scenario.endswith("_exact") else 0.1 * job.seed**2
        figures = {} if name == "bad" else {"flight_ate_percent": error}
        rows.append(crashed(job, "") | {"estimators": {name: figures}})
    write_page(suite, plan, rows, tmp_path / "SUITE.md", "runtime suite")
    page = (tmp_path / "SUITE.md").read_text(encoding="utf-8")
    assert line_of(page, "estimator").endswith("| quick: errs / exact |")
    assert line_of(page, "good").endswith("| × 4 (1 to 9) |")
    assert line_of(page, "bad").endswith("|  |")
    assert "## quick_exact" not in page


@pytest.mark.slow
def test_a_crash_that_a_later_try_mended_is_still_told(small: Path, tmp_path: Path) -> None:
    def mended(row: Row) -> Row:
        return row | {"crashes": ["its worker died"]} if row["seed"] == 2 else row

    page = page_of(read_suite(small), tmp_path, mended)
    assert "**failed** 1 of" in line_of(page, "bad")
    assert "failed" not in line_of(page, "good")
    assert page.count("- bad: its worker died\n") == 2


@pytest.mark.slow
def test_a_flaw_of_the_flight_is_told_and_is_not_the_estimators(
    small: Path, tmp_path: Path
) -> None:
    """A vehicle that met somebody has missed a threshold of its own."""

    def collided(row: Row) -> Row:
        missed = {"passed": False, "collisions": 1, "failed": ["collisions: expected at most 0"]}
        return row | {"passed": False, "flights": {"drone": missed}}

    page = page_of(read_suite(small), tmp_path, collided)
    assert "failed**" not in line_of(page, "bad")
    flaw = "**The flight itself is flawed**: seed 1, drone: collisions: expected at most 0; seed 2,"
    assert page.count(flaw) == 2


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("scenario", read_suite().scenarios, ids=lambda scenario: scenario.name)
def test_every_scenario_is_flown_to_its_end_and_meets_nothing(
    scenario: Scenario, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without its sensors: whether the way is free of walls, and of people at that time."""
    monkeypatch.chdir(tmp_path)
    table = tomllib.loads((FOLDER / "rig.toml").read_text(encoding="utf-8"))
    for change in scenario.set:
        if not change.startswith(("camera.", "eye.", "down.")):
            override(table, change)
    (drone,) = (node for node in table["nodes"] if node["name"] == "drone")
    for sensors in ("cameras", "lidars", "trigger"):
        del drone[sensors]
    for seed in (1, 2, 3):
        run = visnav.run(table, seed=seed, quiet=True)
        assert run.summary["reason"] == "pilot: flight completed"
        assert "Collision" not in run.summary["events"]


@pytest.mark.slow
def test_who_is_not_installed_is_named(small: Path, tmp_path: Path) -> None:
    page = page_of(read_suite(small), tmp_path, lambda row: row)
    assert "- elsewhere: `make elsewhere` installs it." in page


def test_a_program_that_is_there_is_installed(small: Path) -> None:
    """Its command is looked for in its folder, relative to the suite's."""

    def installed(command: str) -> bool:
        node = {"type": "Process", "folder": "bin", "command": [command]}
        return Entrant(name="slam", reads="stereo", node=node).installed(small.parent)

    program = small.parent / "bin" / "slam"
    program.parent.mkdir()
    program.write_text("")
    assert not installed("./slam")
    program.chmod(0o755)
    assert installed("./slam")
    assert installed("true")
    assert not installed("no_such_program_anywhere")


def test_flights_that_differ_are_refused(small: Path, tmp_path: Path) -> None:
    """Digests of what the rig's nodes sent are equal for all estimators of a flight."""
    suite = read_suite(small)
    plan = make_plan(suite, out=tmp_path / "out", repeats=1)
    for job in plan.jobs:
        sent = {"drone.images": "a", "pilot.setpoints": "b", f"{job.id}.estimates": job.id}
        Path(job.out).mkdir(parents=True)
        (Path(job.out) / "summary.json").write_text(json.dumps({"digests": sent}))
    digests = flights(suite, plan)
    assert {name: [*by_seed] for name, by_seed in digests.items()} == {"slow": [1], "quick": [1]}
    assert len({digest for by_seed in digests.values() for digest in by_seed.values()}) == 1
    part: dict[str, Any] = {"digests": {"drone.x": "c"}, "error": "its worker died"}
    (Path(plan.jobs[1].out) / "summary.json").write_text(json.dumps(part))
    assert flights(suite, plan) == digests
    part["error"] = ""
    (Path(plan.jobs[1].out) / "summary.json").write_text(json.dumps(part))
    with pytest.raises(ConfigError, match="bad seed=1: expected the flight of the others"):
        flights(suite, plan)


@pytest.mark.slow
def test_the_page_says_where_the_runs_were_made(small: Path, tmp_path: Path) -> None:
    """All places and commits, if there are several, and not those of who writes the page."""
    suite = read_suite(small)
    plan = make_plan(suite, out=tmp_path / "out", repeats=1)
    for job, commit in zip(plan.jobs, ("abc", "def", "abc", "def"), strict=True):
        where = {"system": "an island", "commit": commit, "command": "its own"}
        Path(job.out).mkdir(parents=True)
        summary = json.dumps({"digests": {}, "environment": where})
        (Path(job.out) / "summary.json").write_text(summary)
    rows = [crashed(job, "") for job in plan.jobs]
    write_page(suite, plan, rows, tmp_path / "SUITE.md", "runtime suite")
    page = (tmp_path / "SUITE.md").read_text(encoding="utf-8")
    assert page.endswith("- system: an island\n- commit: abc, def\n")


def test_an_estimator_without_rows_has_no_cell(small: Path) -> None:
    assert cells(make_plan(read_suite(small), out=Path("out")), []) == {}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_command_runs_a_suite_and_runs_it_on(small: Path, tmp_path: Path) -> None:
    words = ["suite", "--file", str(small), "--out", str(tmp_path / "out"), "--scenario", "slow"]
    words += ["--repeat", "1"]
    done = command(*words, folder=tmp_path, limit=300)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out" / "SUITE.md").read_text(encoding="utf-8")
    assert "2 runs: 1 seed." in page
    assert re.search(r"Digest of the flight: seed 1 `[0-9a-f]{16}`\.", page)
    assert re.search(r"\| good \| truth \| unknown \| 0\.\d+ \|", page)
    assert "**failed**" in line_of(page, "bad")
    assert (tmp_path / "out" / "suite" / "suite.png").stat().st_size > 1000
    again = command(*words, folder=tmp_path, limit=300)
    assert "2 runs are finished already, 0 to do" in again.stderr


@pytest.mark.parametrize("file", ["suite.toml", "calibration.toml", "carried.toml", "long.toml"])
def test_programs_are_those_of_the_checkout(file: str) -> None:
    folders = [e.node["folder"] for e in read_suite(FOLDER / file).estimators if "folder" in e.node]
    root = Path(__file__).parents[4]
    assert {(FOLDER / folder).resolve() for folder in folders} == {root}
