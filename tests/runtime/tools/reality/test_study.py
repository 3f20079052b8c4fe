"""The study's plan, its keys and its ledger: what is flown, left out, counted, stale."""

from __future__ import annotations

import itertools
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config.reading import parse
from runtime.errors import CommandError, ConfigError
from runtime.tools.reality.results import FIELDS, Ledger, Result, result_of
from runtime.tools.reality.study import (
    FOLDER,
    Part,
    Run,
    Study,
    key_of,
    keys_of,
    make_plan,
    read_published,
    read_study,
    table_of,
    truths,
)
from runtime.tools.suite.plan import Entrant
from runtime.tools.sweep.plan import make_job
from runtime.tools.sweep.tables import crashed

WORLD = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1"/>
    <geom name="wall" type="box" size="1 20 3" pos="4 0 3"/>
  </worldbody>
</mujoco>
"""
RIG = """
[run]
name = "reality"

[[nodes]]
name = "drone"
type = "Carried"
trajectory = "a motion"
axes = "nwu"
world = "world.xml"
place = { position = [0.0, 0.0, -1.2] }

[[nodes.cameras]]
name = "cam0"
width = 8
height = 6
images = ["grey"]
"""
STUDY = """
rig = "rig.toml"
coverage_percent = 50.0
frame_ms = 100.0

[[sequences]]
name = "S1"
seeds = 2

[[sequences]]
name = "S2"
seeds = 1

[[worlds]]
name = "wall"
set = ["drone.margin=0.1"]

[[worlds]]
name = "given"
scan = true

[[conditions]]
name = "real"

[[conditions]]
name = "sharp"
set = ["cam0.exposure=0ms"]
sequences = ["S1"]
worlds = ["wall"]

[[systems]]
name = "good"
reads = "truth"
published = "DSO, mono"
node = { type = "SyntheticOdometry", drift = 0.5 }

[[systems]]
name = "other"
reads = "truth"
set = ["cam0.width=16"]
node = { type = "SyntheticOdometry", drift = 5.0 }

[[systems]]
name = "elsewhere"
reads = "nothing"
module = "a_module_that_is_not_there"
install = "make elsewhere"
node = { type = "SyntheticOdometry" }
"""


def motion(path: Path, radius: float = 1.0) -> None:
    """Write a circle of a body whose axes are EuRoC's, its nose ahead, as EuRoC's truth."""
    seconds = np.arange(0.0, 3.0, 0.02)
    angle = 0.5 * seconds
    half = angle / 2 + np.pi / 4  # of the heading; (x up, y right, z ahead) is turned before
    up = np.array([0.5, -0.5, -0.5, -0.5]) * [1, -1, 1, -1]
    lines = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y []"
    ]
    lines[0] += ", q_RS_z []"
    for at, a, h in zip(seconds, angle, half, strict=True):
        w, x, y, z = up
        c, s = np.cos(h), np.sin(h)
        turn = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
        place = radius * np.cos(a), radius * np.sin(a), 1.2
        words = ",".join(f"{value:.9f}" for value in (*place, *turn))
        lines.append(f"{10**18 + round(at * 1e9)},{words}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def small(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    (tmp_path / "world.xml").write_text(WORLD, encoding="utf-8")
    (tmp_path / "study.toml").write_text(STUDY, encoding="utf-8")
    motion(tmp_path / "truth" / "S1_easy.csv")
    return tmp_path / "study.toml"


def names(study: Study, **options: Any) -> list[tuple[str, ...]]:
    return [tuple(map(str, run)) for run in keys_of(study, **options)]


def test_the_projects_own_study_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    """All settings exist; who counts has published figures; at least six count."""
    study, published = read_study(), read_published().errors()
    keys = keys_of(study)
    counted = [system for system in study.systems if not system.why_not]
    assert len(counted) >= 6
    assert all(len(published[s.published]) >= 10 for s in counted)
    assert not [s for s in study.systems if s.published and s.published not in published]
    assert {run.sequence for run in keys} <= {*published["ORB-SLAM3, stereo"]}
    ours = {"StereoOdometry", "StereoInertialOdometry"}
    assert all(s.why_not for s in study.systems if s.node["type"] in ours)
    monkeypatch.setattr(Entrant, "installed", lambda *_: True)
    for system in study.systems:
        table = table_of(study, Run("V1_02", "rich", "real", 1, system.name))
        folder = FOLDER / system.node.get("folder", ".")
        assert folder.resolve() in {FOLDER, FOLDER.parents[2]}
        assert len(key_of(table, FOLDER)) == 12


def test_published_figures_are_read_by_row() -> None:
    rows = read_published().errors()
    assert rows["ORB-SLAM3, stereo"]["V2_03"] == 0.361
    assert rows["ORB-SLAM3, mono"]["V2_03"] == float("inf")
    assert "V2_03" not in rows["Basalt, stereo-inertial"]
    assert rows["OpenVINS, mono-inertial"]["V1_02"] == 0.11


def test_a_row_with_a_word_too_few_is_refused(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(
        '[[tables]]\nsource = "s"\nshows = ""\nsequences = "a b"\n[tables.rows]\nx = ".1"\n'
    )
    with pytest.raises(ConfigError, match=r"x: expected 2 words, found 1"):
        read_published(tmp_path / "p.toml").errors()


@pytest.mark.parametrize(
    ("line", "other", "message"),
    [
        (
            'sequences = ["S1"]',
            'sequences = ["S3"]',
            r"sharp: sequences: expected of S1, S2, found S3",
        ),
        (
            'worlds = ["wall"]',
            'worlds = ["wal"]',
            r"sharp: worlds: expected of wall, given, found wal",
        ),
        (
            'name = "sharp"',
            'name = "sharp"\nagainst = "raal"',
            r"sharp: against: expected of real, sharp, found raal",
        ),
        (
            'name = "sharp"',
            'name = "real"',
            r"conditions: expected each name once, found twice real",
        ),
        ('name = "S2"', 'name = "S1"', r"sequences: expected each name once, found twice S1"),
    ],
)
def test_a_name_that_is_not_there_or_twice_is_refused(
    line: str, other: str, message: str, small: Path
) -> None:
    small.write_text(STUDY.replace(line, other))
    with pytest.raises(ConfigError, match=message):
        read_study(small)


def test_runs_that_say_most_come_first(small: Path) -> None:
    study = read_study(small).only(systems=["good"])
    assert names(study) == [
        ("S1", "wall", "real", "1", "good"),
        ("S2", "wall", "real", "1", "good"),
        ("S1", "given", "real", "1", "good"),
        ("S2", "given", "real", "1", "good"),
        ("S1", "wall", "real", "2", "good"),
        ("S1", "given", "real", "2", "good"),
        ("S1", "wall", "sharp", "1", "good"),
        ("S1", "wall", "sharp", "2", "good"),
    ]
    assert len(names(study, seeds=1)) == 5
    with pytest.raises(CommandError, match=r"--worlds: expected some of wall, given, found wal"):
        study.only(worlds=["wal"])


def test_what_cannot_be_flown_is_told(small: Path, tmp_path: Path) -> None:
    """No truth, no scan, no program, no room for the motion; what is finished is counted."""
    motion(tmp_path / "truth" / "S2" / "data.csv", radius=3000.0)
    study = read_study(small)
    keys = keys_of(study, 1)
    files = truths(tmp_path / "truth", study.sequences)
    assert {name: path.name for name, path in files.items()} == {
        "S1": "S1_easy.csv",
        "S2": "data.csv",
    }
    planned = make_plan(study, keys, out=tmp_path / "out", truth=files)
    assert {run.sequence for run in planned.jobs} == {"S1"}
    assert planned.flights(study) == 4, "the other system has a flight of its own"
    reasons = [*planned.absent]
    assert "elsewhere: not installed (make elsewhere)" in reasons
    assert "given: no scan is given by --outside" in reasons
    assert any(why.startswith("S2 in wall: ") and "500 m/s²" in why for why in reasons)
    assert sum(planned.absent.values()) + len(planned.jobs) == len(keys)
    assert planned.hours(study) == pytest.approx(4 * 20 * 5.48 * 150 / 3.6e6, rel=0.01)
    del files["S2"]
    done = next(iter(planned.jobs))
    rest = make_plan(
        study, keys, out=tmp_path / "out", truth=files, wanted=lambda run, _: run != done
    )
    assert {*planned.jobs} - {*rest.jobs} == {done}
    assert rest.finished == 1
    assert rest.absent["S2: no file of its truth in the folder of --truth"] == 6


def test_the_files_of_the_truth(tmp_path: Path) -> None:
    """EuRoC's layout, of a whole data set the truth alone, and a corrected one before any other."""
    parts = [Part(name=name) for name in ("V1_01", "V1_02", "V1_03")]
    for name in ("V1_01_easy_original.csv", "V1_01_easy.csv", "V1_01_easy.txt", "V1_02.tum"):
        (tmp_path / name).write_text("")
    for sensor in ("cam0", "state_groundtruth_estimate0"):
        (tmp_path / "V1_03" / "mav0" / sensor).mkdir(parents=True)
        (tmp_path / "V1_03" / "mav0" / sensor / "data.csv").write_text("")
    files = {n: str(p.relative_to(tmp_path)) for n, p in truths(tmp_path, parts).items()}
    truth = "V1_03/mav0/state_groundtruth_estimate0/data.csv"
    assert files == {"V1_01": "V1_01_easy.csv", "V1_02": "V1_02.tum", "V1_03": truth}
    assert truths(None, parts) == {}
    with pytest.raises(CommandError, match=r"--truth: expected a folder, found .*nowhere"):
        truths(tmp_path / "nowhere", parts)


def test_a_key_is_that_of_the_settings_and_of_nothing_else(small: Path, tmp_path: Path) -> None:
    """Equal in another folder; another for another rig, node, world, condition, not for a seed."""
    keys = keys_of(read_study(small))
    other = tmp_path / "other"
    other.mkdir()
    for name in ("rig.toml", "study.toml"):
        (other / name).write_text((small.parent / name).read_text())
    assert keys_of(read_study(other / "study.toml")) == keys
    by_key: dict[str, set[tuple[str, ...]]] = {}
    for run, key in keys.items():
        by_key.setdefault(key, set()).add((run.sequence, run.world, run.condition, run.system))
    assert all(len(own) == 1 for own in by_key.values())
    for file, before, after in (
        ("rig.toml", "height = 6", "height = 7"),
        ("study.toml", "drift = 0.5", "drift = 0.6"),
    ):
        text = (other / file).read_text()
        (other / file).write_text(text.replace(before, after))
        changed = {r for r, k in keys_of(read_study(other / "study.toml")).items() if k != keys[r]}
        (other / file).write_text(text)
        only = {"study.toml": {"good"}, "rig.toml": {"good", "elsewhere", "other"}}[file]
        assert {run.system for run in changed} == only


def test_a_key_is_that_of_templates_content(tmp_path: Path) -> None:
    table = {"nodes": [{"files": [{"path": "x", "template": "t.jinja"}]}]}
    (tmp_path / "t.jinja").write_text("one")
    first = key_of(table, tmp_path)
    (tmp_path / "t.jinja").write_text("another")
    assert key_of(table, tmp_path) != first


def result(seed: int = 1, system: str = "good", **more: Any) -> Result:
    run: dict[str, Any] = {"sequence": "S1", "world": "wall", "condition": "real", "seed": seed}
    usual: dict[str, Any] = {"verdict": "passed", "ate_m": 0.1, "key": "k", "data": "d"}
    return Result(**(usual | run | {"system": system} | more))


def test_a_ledger_keeps_what_it_is_given(tmp_path: Path) -> None:
    path = tmp_path / "bench" / "reality.csv"
    results = [result(3, cpu_ms=1.5), result(1, verdict="crashed", ate_m=None, error='a, b\n"c"')]
    Ledger(path).add(results)
    again = [*Ledger(path).results.values()]
    head, first, second = path.read_text().splitlines()
    assert head == ",".join(FIELDS)
    assert first.startswith("S1,wall,real,1,good,crashed,,")
    assert second.startswith("S1,wall,real,3,good,passed,0.1,")
    assert again[0].error == 'a, b "c"'
    assert again[1] == results[0]


def test_whatever_the_order_the_file_is_the_same(tmp_path: Path) -> None:
    """Added one by one or together, in any order, by two ledgers at once: the same bytes."""
    results = [result(seed, name) for seed in range(1, 12) for name in ("a", "b")]
    Ledger(tmp_path / "one.csv").add(results)
    shuffled = random.Random(1).sample(results, len(results))
    ledgers = [Ledger(tmp_path / "many.csv") for _ in range(2)]
    for one, ledger in zip(shuffled, itertools.cycle(ledgers)):
        ledger.add([one])
    text = (tmp_path / "one.csv").read_bytes()
    assert (tmp_path / "many.csv").read_bytes() == text
    head, *lines = text.splitlines(keepends=True)
    merged = tmp_path / "merged.csv"  # as git's union leaves it: out of order, some lines twice
    merged.write_bytes(head + b"".join(lines[10:] + lines[:14]))
    assert Ledger(merged).text().encode() == text


def test_a_crash_gives_way_and_nothing_else_does(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "r.csv")
    broken = result(verdict="crashed", ate_m=None)
    ledger.add([broken])
    assert ledger.has(broken.run, "k", "d")
    assert not ledger.has(broken.run, "k", "d", crashed=False)
    ledger.add([result(ate_m=0.2)])
    ledger.add([result(ate_m=0.3), broken])
    assert [r.ate_m for r in Ledger(tmp_path / "r.csv").results.values()] == [0.2]


def test_results_of_other_settings_or_data_are_stale(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "r.csv")
    ledger.add([result(1), result(2, key="old"), result(3, data="other"), result(4), result(5)])
    ledger.add([result(1, key="old")])
    keys = {result(seed).run: "k" for seed in range(1, 5)}
    data = {("S1", "wall"): "d"}
    count, old = ledger.valid(keys, data)
    assert sorted(run.seed for run in count) == [1, 4]
    assert sorted((r.seed, r.key) for r in old) == [(1, "old"), (2, "old"), (3, "k"), (5, "k")]
    count, _ = ledger.valid(keys, data, stale=True)
    assert sorted(run.seed for run in count) == [1, 2, 3, 4]
    assert count[result(1).run].key == "k"
    assert sorted(run.seed for run in ledger.valid(keys, {})[0]) == [1, 3, 4], "data not there"


def test_a_line_that_is_none_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text(",".join(FIELDS) + "\nS1,wall,real,one,good\n")
    with pytest.raises(ConfigError, match=r"r\.csv: line 2: expected a run of the study, found"):
        Ledger(path)


def row_of(small: Path, figures: dict[str, Any], error: str = "") -> Result:
    study = read_study(small)
    run = Run("S1", "wall", "real", 1, "good")
    own = {"good": figures} if figures else {}
    (small.parent / "S1").write_text("")
    job = make_job(
        parse(table_of(study, run), "x", small.parent), (), 1, small.parent, small.parent
    )
    Path(job.out).mkdir(parents=True, exist_ok=True)
    (Path(job.out) / "summary.json").write_text(
        '{"digests": {"drone.x": "1", "good.y": "2"}, "environment": {"commit": "'
        + "a" * 40 + '-dirty"}, "code": {"good": "bbbbbbbbbbbb"}}'
    )  # fmt: skip
    row = crashed(job, error) | {"estimators": own, "workers": {"good.X": {"cpu_p50_ms": 7.0}}}
    return result_of(run, job, row, key="k", data="d", study=study)


def test_a_result_is_what_the_verdict_says(small: Path) -> None:
    figures = {"ate_rmse_m": 0.1, "final_ate_rmse_m": 0.05, "frame_coverage_percent": 80.0}
    one = row_of(small, figures | {"estimates": 200, "final_poses": 100, "coverage_percent": 1.0})
    assert (one.verdict, one.ate_m, one.final_ate_m, one.cpu_ms) == ("passed", 0.1, 0.05, 7.0)
    assert (one.final_percent, one.coverage_percent) == (40.0, 80.0)
    assert (one.commit, one.code, len(one.flight)) == ("a" * 10 + "-dirty", "bbbbbbbb", 12)


@pytest.mark.parametrize(
    ("figures", "error", "verdict"),
    [
        ({"ate_rmse_m": 0.1, "coverage_percent": 49.0}, "", "lost"),
        ({"ate_rmse_m": None, "coverage_percent": 99.0}, "", "lost"),
        ({}, "", "lost"),
        ({}, "its worker died", "crashed"),
    ],
)
def test_who_says_too_little_is_lost(
    small: Path, figures: dict[str, Any], error: str, verdict: str
) -> None:
    one = row_of(small, figures, error)
    study = read_study(small)
    assert one.verdict == verdict
    assert one.failed(study.systems[0], study)


def test_a_final_map_of_a_part_of_the_images_has_failed() -> None:
    study = read_study()
    final_map, keyframes, streamed = (
        next(system for system in study.systems if system.final == kind)
        for kind in ("map", "keyframes", "")
    )
    part = result(final_ate_m=0.01, final_percent=30.0, coverage_percent=90.0)
    assert part.failed(final_map, study)
    assert not part.failed(keyframes, study)
    assert not part.failed(streamed, study)
    errors = [part.error_m(system) for system in (final_map, keyframes, streamed)]
    assert errors == [0.01, 0.01, 0.1]
