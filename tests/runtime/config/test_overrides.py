"""Changing settings from the command line, and writing them down again."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from runtime import Duration
from runtime.config.model import Config, RunConfig, to_builtins
from runtime.config.reading import parse
from sims.multirotor import MultirotorConfig
from tests.runtime.config.test_config import CAMERAS, DRONE, SPEAKER, message, read
from tests.runtime.samples import Speaker, SpeakerConfig

BAD_OVERRIDES = [
    pytest.param("s.a=" + "9" * 5000, "...: expected a number of a usual size", id="digits"),
    pytest.param("s.a=" + "[" * 100_000, "...: expected a value, found brackets", id="brackets"),
    ("s.rate=1\nx=2", "expected one setting, found more lines"),
    ("x", "--set x: expected node.key=value or run.key=value"),
    ("drone=1", "--set drone=1: expected node.key=value or run.key=value"),
    ("frnt.rate=3", "expected run or a node (drone), found \"frnt\" (did you mean 'front'?)"),
    ("run..seed=1", "expected node.key=value or run.key=value"),
    ("dron.a=1", "expected run or a node (drone), found \"dron\" (did you mean 'drone'?)"),
    ("drone.cameras.frnt.rate=3", 'cameras: expected one of front, down; found "frnt" (did you'),
    ("drone.cameras.frnt=3", 'cameras: expected one of front, down; found "frnt"'),
    ("drone.cameras.front=3", "cameras: expected a table, since .front follows"),
    ("run.seed=abc", 'c.toml: run.seed: expected a whole number, found "abc"'),
    ("drone.position.a.b=1", "(drone): position: expected a list"),
]


@pytest.mark.parametrize(("override", "expected"), BAD_OVERRIDES)
def test_mistakes_in_overrides(tmp_path: Path, override: str, expected: str) -> None:
    assert expected in message(tmp_path, DRONE + CAMERAS, override)


@pytest.mark.parametrize("text", ["nodes = 3", "nodes = [3]", "run = 3\n" + SPEAKER])
def test_overrides_of_a_broken_file_are_no_crash(tmp_path: Path, text: str) -> None:
    assert "expected" in message(tmp_path, text, "run.seed=3")
    assert "expected" in message(tmp_path, text, "drone.rate=3")
    assert "expected" in message(tmp_path, "nodes = [3, {name = 'drone'}]", "drone.type=x:Y")


def test_a_table_with_a_name_of_its_own_needs_no_path(tmp_path: Path) -> None:
    config = read(tmp_path, DRONE + CAMERAS, "front.rate=7")
    assert isinstance(config.nodes[0].config, MultirotorConfig)
    assert [camera.rate for camera in config.nodes[0].config.cameras] == [7, 30]


def test_a_table_whose_name_is_not_its_own_needs_a_path(tmp_path: Path) -> None:
    twice = DRONE + CAMERAS + (DRONE + CAMERAS).replace('name = "drone"', 'name = "other"')
    expected = "expected one of drone.cameras.front, other.cameras.front"
    assert expected in message(tmp_path, twice, "front.rate=7")


def test_overrides_change_plain_and_nested_settings(tmp_path: Path) -> None:
    config = read(
        tmp_path,
        DRONE + CAMERAS + SPEAKER,
        *("run.seed=7", "run.duration=6s", "run.name=two words", 's.text="quoted"'),
        *("drone.cameras.down.rate=10", "drone.imu.gyroscope_noise_density=0.5", "s.pause=80ms"),
        *("drone.position=[1, 2]", "drone.world=yard"),
    )
    run, drone, speaker = config.run, config.nodes[0].config, config.nodes[1].config
    assert (run.seed, run.duration, run.name) == (7, 6.0, "two words")
    assert isinstance(drone, MultirotorConfig)
    assert [camera.rate for camera in drone.cameras] == [30.0, 10.0]
    assert drone.imu.gyroscope_noise_density == 0.5
    assert (drone.position, drone.world) == ((1.0, 2.0), "yard")
    assert speaker == SpeakerConfig(text="quoted", pause=Duration(0.08))


seconds = st.floats(0, 1e6).map(Duration)
names = st.text(st.characters(exclude_categories=["Cs"]))


def _names_a_folder(name: str) -> bool:
    return bool(name.strip()) and name[0] != "." and not {"/", "\0"} & set(name)


runs = st.builds(
    RunConfig,
    name=names.filter(_names_a_folder),
    clock=st.sampled_from(["lockstep", "real"]),
    speed=st.none() | st.floats(1e-6, 1e6),
    seed=st.integers(0, 2**62),
    duration=seconds,
    digest=st.none() | st.booleans(),
    stall=seconds,
    startup_limit=seconds,
    shutdown_limit=seconds,
    log=st.sampled_from(["trace", "debug", "info", "warning", "error", "fatal"]),
)
speakers = st.builds(SpeakerConfig, rate=st.floats(1e-3, 1e5), text=names, pause=seconds)


@pytest.mark.slow
@given(runs, speakers, st.sampled_from(["stop", "restart", "drop"]))
def test_what_is_written_reads_the_same(run: RunConfig, speaker: Any, on_error: Any) -> None:
    table = {"nodes": [{"name": "s", "type": "tests.runtime.samples:Speaker"}]}
    node = msgspec.structs.replace(parse(table, "").nodes[0], config=speaker, on_error=on_error)
    config = Config(run=run, nodes=(node,))
    text = tomli_w.dumps(to_builtins(config))
    assert parse(tomllib.loads(text), "again") == config


def test_a_resolved_file_holds_every_setting(tmp_path: Path) -> None:
    config = read(tmp_path, DRONE + CAMERAS)
    text = tomli_w.dumps(to_builtins(config))
    assert read(tmp_path, text) == config
    for word in ("control_rate", "gyroscope_noise_density", "depth_noise", "startup_limit"):
        assert word in text


def test_the_class_is_the_one_that_was_named(tmp_path: Path) -> None:
    assert read(tmp_path, SPEAKER).nodes[0].node is Speaker
