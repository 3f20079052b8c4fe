"""Reading settings: what is taken, and a message for every kind of mistake."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from runtime.config.model import Config
from runtime.config.reading import convert, find_node, load, parse
from runtime.errors import ConfigError
from runtime.extras import Offer
from runtime.node import NodeConfig

DRONE = """
[[nodes]]
name = "drone"
type = "Multirotor"
"""
CAMERAS = """
[[nodes.cameras]]
name = "front"
[[nodes.cameras]]
name = "down"
"""
SPEAKER = """
[[nodes]]
name = "s"
type = "tests.runtime.samples:Speaker"
"""


def read(tmp_path: Path, text: str, *overrides: str) -> Config:
    path = tmp_path / "c.toml"
    path.write_text(text, encoding="utf-8")
    return load(path, overrides)


def message(tmp_path: Path, text: str, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text, *overrides)
    return str(caught.value)


IN_RUN = [
    ('clok = "real"', "run: found unknown key ", "'clok' (did you mean 'clock'?)"),
    ('clock = "fast"', 'run.clock: expected "lockstep" or "real"', 'found "fast"'),
    ("seed = -1", "run.seed: expected a whole number >= 0", "found -1"),
    ("seed = 1.5", "run.seed: expected a whole number", "found 1.5"),
    ('duration = "5 parsec"', "run.duration: found ", '"5 parsec", of no known unit'),
    ("duration = -1", "run.duration: expected a duration that is not", "found -1"),
    ("duration = inf", "run.duration: expected a duration such as", "found inf"),
    ("speed = 0", "run.speed: expected a number > 0", "found 0"),
    ('speed = "slow"', 'run.speed: expected a number or "max"', 'found "slow"'),
    ('clock = "real"\nspeed = "max"', 'run.speed: expected a number with clock "real"', '"max"'),
    ('clock = "real"\nspeed = inf', 'run.speed: expected a number with clock "real"', "inf"),
]


@pytest.mark.parametrize(("line", "expected", "rest"), IN_RUN)
def test_mistakes_in_the_run(tmp_path: Path, line: str, expected: str, rest: str) -> None:
    text = message(tmp_path, f"[run]\n{line}\n{SPEAKER}")
    assert text.startswith(f"c.toml: {expected}")
    assert rest in text


IN_DRONE = [
    ("wrld = 1", "found unknown key ", "'wrld' (did you mean 'world'?)"),
    ("world = 1", "world: expected a text", "found 1"),
    ("position = [nan, 0]", "position[0]: expected a finite number", "found nan"),
    ("imu = { g_sensitivity = inf }", "imu.g_sensitivity: expected a finite number", "found inf"),
    ("limits = { min_thrust = 5 }", "limits.min_thrust: expected a number <= 1", "found 5"),
    ("limits = { min_thrust = 0.95 }", "limits: min_thrust: expected less than ", "found 0.95"),
    ("gains = { tilt = -1 }", "gains.tilt: expected a number >= 0", "found -1"),
    ("position = [1]", "position: expected a list of length 2", "found [1]"),
    ('position = [1, "a"]', "position[1]: expected a number", 'found "a"'),
    ("control_rate = 0", "control_rate: expected a number > 0", "found 0"),
    ("camera_processes = true", "camera_processes: expected a whole number", "found true"),
    ("imu = 3", "imu: expected a table", "found 3"),
    ("imu = { gyro = 3 }", "imu: found unknown key 'gyro'", "expected one of position, "),
    ("gains = { x = 3 }", "gains: found ", "unknown key 'x'"),
    ("limits = { x = 3 }", "limits: found ", "unknown key 'x'"),
    ('setpoint_timeout = "x"', "setpoint_timeout: expected a duration such as", 'found "x"'),
    ("cameras = 3", "cameras: expected a list", "found 3"),
    (CAMERAS + 'rate = "x"', "cameras[1].rate: expected a number", 'found "x"'),
    (CAMERAS + "rte = 3", "cameras[1]: found unknown key ", "(did you mean 'rate'?)"),
    (CAMERAS + "fov = 200", "cameras[1]: fov: expected at most 170 degrees ", "found 200 degrees"),
    (CAMERAS + 'images = ["red"]', 'cameras[1].images[0]: expected "rgb" or', 'found "red"'),
    (CAMERAS + "images = []", "cameras[1]: images: expected one or more", "found none"),
    ("[[nodes.cameras]]\nrate = 3", 'cameras[0]: expected a setting "name"', "found none"),
    ('inputs = { setponts = "pilot" }', "inputs: expected an input or", "mean 'setpoints'?)"),
]


@pytest.mark.parametrize(("line", "expected", "rest"), IN_DRONE)
def test_mistakes_in_a_node(tmp_path: Path, line: str, expected: str, rest: str) -> None:
    text = message(tmp_path, SPEAKER + DRONE + line)
    assert text.startswith(f"c.toml: nodes[1] (drone): {expected}")
    assert rest in text


OF_NODES = [
    ('type = "a:B"', 'nodes[0]: expected a setting "name", found none'),
    ('name = "x"', 'nodes[0]: expected a setting "type", found none'),
    ("name = 3", "nodes[0].name: expected a text, found 3"),
    ('name = "a b"\ntype = "a:B"', "nodes[0].name: expected a letter, then letters, digits,"),
    ('name = "run"\ntype = "a:B"', "nodes[0].name: expected any name but those"),
    ('name = "x"\ntype = "a"', 'type: expected the name of a node or "module:Class", found "a"'),
    ('name = "x"\ntype = "Multirotr"', "found \"Multirotr\" (did you mean 'Multirotor'?)"),
    ('name = "x"\ntype = "..a:B"', 'the name of a node or "module:Class", found "..a:B"'),
    ('name = "x"\ntype = "nodes.replay:A"', "\"nodes.replay\" (did you mean 'nodes.data.replay'?)"),
    ('name = "x"\ntype = "nodes.pilots:Teleob"', "found \"Teleob\" (did you mean 'Teleop'?)"),
    (
        'name = "x"\ntype = "nodes.pilots.pilot:Node"',
        'expected a node of nodes.pilots.pilot, found "Node"',
    ),
    ('name = "x"\ntype = "os.path:join"', 'expected a node of os.path, found "join"'),
    ('name = "x"\ntype = "a:B"\non_error = "cry"', 'on_error: expected "stop" or "restart" or'),
]


@pytest.mark.parametrize(("lines", "expected"), OF_NODES)
def test_mistakes_in_name_and_type(tmp_path: Path, lines: str, expected: str) -> None:
    assert expected in message(tmp_path, f"[[nodes]]\n{lines}")


OF_FILES = [
    ("", "nodes: expected at least one [[nodes]] table, found none"),
    ("nodes = 3", "nodes: expected at least one [[nodes]] table, found none"),
    ("nodes = [3]", "nodes[0]: expected a table, found 3"),
    (
        "[nods]",
        "expected tables [run], [network] and [[nodes]], found 'nods' (did you mean 'nodes'?)",
    ),
    ("run = 3", "run: expected a table, found 3"),
    ('a = "', "expected TOML, found: Unterminated string"),
    (SPEAKER + SPEAKER, "nodes[1].name: expected a name that no other node has, found"),
    (SPEAKER + "rate = 0", "(s): rate: expected a rate above 0, up to 100000 Hz, for speak"),
    (SPEAKER + "rate = 1e9", "(s): rate: expected a rate above 0, up to 100000 Hz, for speak"),
    (SPEAKER + '[network]\nmeet = "here"', "network.meet: expected a Zenoh endpoint such as tcp/"),
    (f"a = {2**63 - 1}", "[[nodes]], found 'a'"),
    (f"a = [{-(2**63)}]", "[[nodes]], found 'a'"),
    (f"a = [{2**63}]", "expected whole numbers of 64 bits, found a larger one"),
    (f"a.b = {-(2**63) - 1}", "expected whole numbers of 64 bits, found a larger one"),
    (f"a = {'[' * 32}{']' * 32}", "[[nodes]], found 'a'"),
    (f"a = {'[' * 33}{']' * 33}", "expected tables and lists at most 32 deep, found deeper ones"),
]


@pytest.mark.parametrize(("text", "expected"), OF_FILES)
def test_mistakes_in_the_file(tmp_path: Path, text: str, expected: str) -> None:
    error = message(tmp_path, text)
    assert "c.toml: " in error
    assert expected in error


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    with pytest.raises(ConfigError, match=r"c.toml: expected a readable file, found: No such"):
        load(path)
    with pytest.raises(ConfigError, match="expected a readable file, found: Is a directory"):
        load(tmp_path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"c.toml: expected UTF-8 text, found invalid start"):
        load(path)


def test_a_file_in_a_folder_whose_name_is_no_text(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    assert r"c.toml: expected a path in UTF-8, found" in message(folder, SPEAKER)


def test_a_node_that_two_packages_offer_is_named_by_its_class(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = [Offer("one", "Twice", "a:Twice"), Offer("two", "Twice", "b:Twice")]
    monkeypatch.setattr("runtime.config.reading.offers", lambda _: both)
    with pytest.raises(ConfigError, match="one node named Twice, found a:Twice of one, b:Twice of"):
        find_node("Twice", "here")


def test_a_setting_of_a_type_that_no_file_has_is_a_fault_of_the_node() -> None:
    class Odd(NodeConfig):
        number: complex

    with pytest.raises(NotImplementedError, match="settings of type <class 'complex'>"):
        convert({"number": 1}, Odd, "here")


def test_a_node_beside_the_file_is_found(tmp_path: Path) -> None:
    (tmp_path / "my_own_node.py").write_text("from runtime import Node\nclass Mine(Node): ...\n")
    config = read(tmp_path, '[[nodes]]\nname = "m"\ntype = "my_own_node:Mine"')
    assert config.nodes[0].node.__name__ == "Mine"


def test_a_module_that_needs_another_says_which(tmp_path: Path) -> None:
    (tmp_path / "needy_node.py").write_text("import surely_not_there\n")
    (tmp_path / "wrong_node.py").write_text("from os import surely_not_there\n")
    text = message(tmp_path, '[[nodes]]\nname = "m"\ntype = "needy_node:Mine"')
    assert "needy_node needs a module 'surely_not_there'" in text
    text = message(tmp_path, '[[nodes]]\nname = "m"\ntype = "wrong_node:Mine"')
    assert "wrong_node cannot be imported: cannot import name" in text


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("x = 1\nprint(y)\n", "NameError: name 'y' is not defined ({file}, line 2)"),
        ("def f(:\n", "SyntaxError: invalid syntax (broken_SyntaxError.py, line 1)"),
    ],
)
def test_a_module_that_fails_says_where(tmp_path: Path, code: str, expected: str) -> None:
    name = f"broken_{expected.partition(':')[0]}"
    file = tmp_path / f"{name}.py"
    file.write_text(code)
    text = message(tmp_path, f'[[nodes]]\nname = "m"\ntype = "{name}:Mine"')
    assert f"{name} cannot be imported: {expected.format(file=file)}" in text


@pytest.mark.parametrize("name", ["", "  ", "a/b", "../x", ".hidden"])
def test_a_run_is_named_as_a_folder_can_be(name: str) -> None:
    """The name of the run becomes a folder, and nothing beyond it."""
    node = {"name": "s", "type": "tests.runtime.samples:Speaker"}
    table = {"run": {"name": name}, "nodes": [node]}
    with pytest.raises(ConfigError, match=r"c: run\.name: expected a name for a folder"):
        parse(table, "c")


def test_a_key_of_any_length_gives_one_line_that_can_be_read() -> None:
    with pytest.raises(ConfigError) as caught:
        parse({"run": {"x" * 100_000: 1}, "nodes": []}, "c.toml")
    assert len(str(caught.value)) < 1500
    assert str(caught.value).startswith("c.toml: run")
