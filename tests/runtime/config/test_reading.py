"""Reading a file: its format, its nodes' modules, presets, and figures that are no numbers."""

from __future__ import annotations

import math
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pytest

from runtime import Node, NodeConfig, Tick, every
from runtime.config import reading
from runtime.config.model import RunConfig
from runtime.config.reading import (
    by_name_alone,
    convert,
    find_node,
    find_nodes,
    load,
    load_configuration,
    parse,
)
from runtime.errors import CommandError, ConfigError, MissingDependencyError
from runtime.extras import NODES, Offer
from runtime.paths import InputPath
from tests.runtime.config.test_config import SPEAKER, message, read
from tests.runtime.samples import Speaker

NODE = {"name": "s", "type": "tests.runtime.samples:Speaker"}


def read_words(text: str, name: str, *, warn: Callable[[str], None]) -> dict[str, Any]:
    """Read a format of somebody else's: a name of the run, and nodes, a word each."""
    for _ in range(2):
        warn(f"{Path(name).name}: this format is old")
    run, *nodes = text.split()
    return {"run": {"name": run}, "nodes": [NODE | {"name": node} for node in nodes]}


@pytest.fixture
def formats(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer a format with the suffix ``.words``, and one that is not installed as it should be."""
    words = Offer("other", "words", f"{__name__}:read_words")
    lost = Offer("other", "lost", f"{__name__}:no_such_reader")
    monkeypatch.setattr(reading, "offers", lambda group: [words, lost] * (group != NODES))
    reading._warn_once.cache_clear()


@pytest.mark.usefixtures("formats")
@pytest.mark.parametrize("suffix", ["words", "WORDS"])
def test_a_packages_format_is_chosen_by_the_suffix(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"c.{suffix}"
    file.write_text("tour a b")
    config = load_configuration(file, ["run.seed=3", "b.rate=7"])
    assert (config.run.name, config.run.seed) == ("tour", 3)
    assert [node.name for node in config.nodes] == ["a", "b"]
    assert vars_of(config.nodes[1].config)["rate"] == 7
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"warning: c.{suffix}: this format is old\n")


def vars_of(config: NodeConfig) -> dict[str, Any]:
    return msgspec.structs.asdict(config)


@pytest.mark.usefixtures("formats")
def test_other_files_are_toml_and_an_extensions_are_named(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(SPEAKER)
    assert load_configuration(tmp_path / "c.toml", ["s.rate=7"]).nodes[0].name == "s"
    (tmp_path / "c.lost").write_text("")
    with pytest.raises(CommandError, match="lost of the package other: expected"):
        load_configuration(tmp_path / "c.lost")
    (tmp_path / "c.JSON").write_text("{}")
    with pytest.raises(
        ConfigError, match=r"c\.JSON: \.JSON is read by the extension visnav-airsim"
    ):
        load_configuration(tmp_path / "c.JSON")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = " + "9" * 5000, "c.toml: expected numbers of a usual size, found: Exceeds the limit"),
        ("a = " + "[" * 20_000, "c.toml: expected TOML, found brackets nested too deep"),
        (
            SPEAKER + "[nodes.links]\npings = { delay = 1 }",
            "links: expected an input or handler of",
        ),
        (SPEAKER + "inputs = { pings = 'x' }", "inputs: expected an input or handler of"),
        (SPEAKER + "rate = -0.0", "rate: expected a rate above 0, up to 100000 Hz, for speak"),
        (SPEAKER + "rate = 100000.1", "rate: expected a rate above 0, up to 100000 Hz, for speak"),
        (SPEAKER.replace('"s"', '"network"'), "expected any name but those of the file's other"),
        (SPEAKER.replace('"s"', '"4s"'), "expected a letter, then letters, digits, _ and -"),
        ("[run]\nname = 'a\\u0000b'\n" + SPEAKER, "run.name: expected TOML"),
    ],
    ids=str,
)
def test_further_mistakes_in_a_file(text: str, expected: str, tmp_path: Path) -> None:
    if expected == "run.name: expected TOML":
        text, expected = text.replace("'", '"'), "run.name: expected a name for a folder"
    assert expected in message(tmp_path, text)


@pytest.mark.parametrize("rate", [1e-3, 1, 100_000])
def test_any_rate_within_the_limits_is_one(rate: float, tmp_path: Path) -> None:
    config = read(tmp_path, f"{SPEAKER}rate = {rate}").nodes[0]
    assert vars_of(config.config)["rate"] == rate
    assert config.on_error == "stop"


def test_a_rate_that_is_no_number_is_a_mistake() -> None:
    class Timed(NodeConfig):
        rate: str = "often"

    class Clockwork(Node[Timed]):
        @every(hz="rate")
        def tick(self, tick: Tick) -> None: ...

    globals()["Clockwork"] = Clockwork
    try:
        with pytest.raises(ConfigError, match=r"\(s\): rate: expected a rate above 0, .*\"often\""):
            parse({"nodes": [NODE | {"type": f"{__name__}:Clockwork"}]}, "c")
    finally:
        del globals()["Clockwork"]


@pytest.mark.parametrize("speed", ["max", math.inf, 2.0])
def test_simulated_time_may_go_as_fast_as_it_can(speed: Any) -> None:
    assert parse({"run": {"speed": speed}, "nodes": [NODE]}, "c").run.speed == speed


def test_real_time_may_have_a_pace() -> None:
    run = parse({"run": {"speed": 2.0, "clock": "real"}, "nodes": [NODE]}, "c").run
    assert (run.clock, run.speed) == ("real", 2.0)


def test_the_network_is_read_too(tmp_path: Path) -> None:
    (tmp_path / "fleet.json5").write_text("{}")
    network = {"meet": "udp/10.0.0.2:7450", "zenoh": "fleet.json5"}
    config = parse({"nodes": [NODE], "network": network}, "c", tmp_path)
    assert config.network.meet == "udp/10.0.0.2:7450"
    assert config.network.zenoh == str(tmp_path / "fleet.json5")


class Paths(NodeConfig):
    map: InputPath = ""


class Mapped(Node[Paths]):
    """Reads a file."""


def test_a_path_starts_in_the_folder_of_the_file_or_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = {"nodes": [{"name": "m", "type": f"{__name__}:Mapped", "map": "a.ply"}]}
    monkeypatch.chdir(tmp_path)
    for folder in (None, tmp_path / "b"):
        config = parse(table, "c", folder).nodes[0].config
        assert isinstance(config, Paths)
        assert config.map == str((folder or tmp_path) / "a.ply")


def test_modules_of_nodes_are_looked_for_beside_the_file_last(tmp_path: Path) -> None:
    before = [*sys.path]
    try:
        for _ in range(2):
            read(tmp_path, SPEAKER)
        assert sys.path == [*before, str(tmp_path)]
    finally:
        sys.path[:] = before


# Nodes.


def offering(monkeypatch: pytest.MonkeyPatch, *offered: tuple[str, str, str]) -> None:
    monkeypatch.setattr(reading, "offers", lambda _: [Offer(*offer) for offer in offered])


def test_nodes_of_packages_are_listed_by_name_and_those_of_one_name_by_class(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    offering(
        monkeypatch,
        ("one", "Talker", "tests.runtime.samples:Speaker"),
        ("one", "Twice", "tests.runtime.samples:Reader"),
        ("two", "Twice", "tests.runtime.samples:Echo"),
        ("two", "Lost", "tests.runtime.samples:Losst"),
    )
    warnings: list[str] = []
    nodes = find_nodes(warnings.append)
    assert [*nodes] == ["Talker", "tests.runtime.samples:Echo", "tests.runtime.samples:Reader"]
    assert nodes["Talker"] is Speaker
    (warning,) = warnings
    assert warning.startswith("a node of the package two: tests.runtime.samples:Losst: expected a")


def test_one_class_offered_twice_is_one_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """As by an installed package, and the folder that it was made of."""
    offer = ("Talker", "tests.runtime.samples:Speaker")
    offering(monkeypatch, ("one", *offer), ("other", *offer))
    assert find_node("Talker", "here") is Speaker


@pytest.mark.parametrize(
    ("type_", "expected"),
    [
        ("Px4", "here: Px4 is a node of the extension visnav-mavlink: pip install ./extensions/"),
        ("Talkr", "found \"Talkr\" (did you mean 'Talker'?)"),
        ("sims.multirotr:Multirotor", "(did you mean 'sims.multirotor'?)"),
        ("nodes.pilot:Pilot", "(did you mean 'nodes.pilots'?)"),
        (f"{__name__}:Node", 'expected a node of tests.runtime.config.test_reading, found "Node"'),
        (f"{__name__}:Paths", 'found "Paths"'),
        (f"{__name__}:NODE", 'found "NODE"'),
        (f"{__name__}:Mappd", "(did you mean 'Mapped'?)"),
        (f"{__name__}:Unfinishd", 'found "Unfinishd"'),
        (f"{__name__}:Unfinished", "expected `async def locate`, `def look` in it, found none"),
    ],
)
def test_a_node_that_is_none_is_named_with_what_may_be_meant(
    type_: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    offering(monkeypatch, ("one", "Talker", "tests.runtime.samples:Speaker"))
    with pytest.raises(ConfigError) as caught:
        find_node(type_, "here")
    assert expected in str(caught.value)
    assert "'Unfinished'" not in str(caught.value)  # which is none for a file


class Unfinished(Node, ABC):
    """Lacks what makes it a node."""

    @abstractmethod
    def look(self) -> None: ...

    @abstractmethod
    async def locate(self) -> None: ...


BROKEN = {
    "needs": (
        "raise ModuleNotFoundError('no luck')",
        "broken_needs needs a module None",
    ),
    "declares": (
        "from runtime import Node, on\n"
        "class Base(Node):\n"
        "    def __init_subclass__(cls, **options):\n"
        "        super().__init_subclass__(**options)\n"
        "class Mine(Base):\n"
        "    @on(int)\n"
        "    def hear(self, event): ...\n",
        "({folder}/broken_declares.py, line {line})",
    ),
    "raises": (
        "def f():\n    raise LookupError('no wires')\n\ndef g():\n    f()\n\ng()\n",
        "cannot be imported: LookupError: no wires ({folder}/broken_raises.py, line 2)",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_module_that_cannot_be_imported_is_one_line_with_its_place(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, expected = BROKEN[name]
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / f"broken_{name}.py").write_text(text)
    with pytest.raises(ConfigError) as caught:
        find_node(f"broken_{name}:Mine", "here")
    found = re.sub(r"line [56]\)", "line {line})", str(caught.value))  # Python 3.13 says another
    expected = expected.replace("{folder}", str(tmp_path))
    assert expected in found


def test_a_missing_extra_of_a_module_says_what_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "wants_an_extra.py").write_text(
        "from runtime.errors import MissingDependencyError\n"
        "raise MissingDependencyError('expected lidar: pip install lidar')\n"
    )
    with pytest.raises(MissingDependencyError, match=r"^expected lidar: pip install lidar$"):
        find_node("wants_an_extra:Mine", "here")


# Figures and presets.


class Judged(NodeConfig):
    limit: float = 1.0
    thresholds: dict[str, float] = msgspec.field(default_factory=dict)


@pytest.mark.parametrize(
    ("table", "type_", "refused"),
    [
        ({"thresholds": {"ate": math.inf}}, Judged, ""),
        ({"thresholds": {"ate": math.nan}}, Judged, "thresholds"),
        ({"limit": math.inf}, Judged, "limit"),
        ({"limit": -math.inf}, Judged, "limit"),
        ({"speed": math.inf}, RunConfig, ""),
        ({"speed": math.nan}, RunConfig, "speed"),
    ],
)
def test_only_a_speed_and_thresholds_may_be_infinite(
    table: dict[str, Any], type_: Any, refused: str
) -> None:
    if not refused:
        assert msgspec.structs.asdict(convert(table, type_, "here")).items() >= table.items()
        return
    with pytest.raises(ConfigError, match=rf"^here\.?:? ?{refused}.*: expected a finite number"):
        convert(table, type_, "here")


LENSES = {
    "wide": {"fov": 120.0, "size": {"width": 64, "height": 48}, "centre": 32.0},
    "plain": {"fov": 60.0},
}
SIZES = {"tiny": {"width": 4, "height": 3}}
Meta = msgspec.Meta


class Size(NodeConfig):
    preset: Annotated[str | None, Meta(extra={"presets": SIZES})] = None
    width: int = 640
    height: int = 480


class Lens(NodeConfig):
    preset: Annotated[str | None, Meta(extra={"presets": LENSES, "needed": {"fov": "centre"}})] = (
        None
    )
    fov: float = 90.0
    centre: float | None = None
    size: Size = Size()


class Rig(NodeConfig):
    lenses: tuple[Lens, ...] = ()
    by_side: dict[str, float] = msgspec.field(default_factory=dict)


class Required(NodeConfig):
    name: str
    preset: Annotated[str | None, Meta(extra={"presets": LENSES})] = None


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        ("wide", Lens(fov=120.0, centre=32.0, size=Size(width=64, height=48))),
        ({"preset": "plain", "centre": 1.0}, Lens(fov=60.0, centre=1.0)),
        ({"preset": "plain", "fov": 70.0}, Lens(fov=70.0)),  # no centre that belongs to another
        (
            {"preset": "wide", "fov": 120.0},
            Lens(fov=120.0, centre=32.0, size=Size(width=64, height=48)),
        ),
        (
            {"preset": "wide", "fov": 70.0, "centre": 30.0, "size": {"width": 60}},
            Lens(fov=70.0, centre=30.0, size=Size(width=60, height=48)),
        ),
        (
            {"preset": "wide", "size": "tiny"},
            Lens(fov=120.0, centre=32.0, size=Size(width=4, height=3)),
        ),
        (
            {"preset": "wide", "size": {"preset": "tiny", "height": 9}},
            Lens(fov=120.0, centre=32.0, size=Size(width=4, height=9)),
        ),
        ({"size": {"width": 60}}, Lens(size=Size(width=60))),
    ],
    ids=str,
)
def test_a_preset_is_a_table_that_the_files_own_keys_override(lens: Any, expected: Lens) -> None:
    table = {"lenses": [{"fov": 10.0}, lens], "by_side": {"left": 1.0}}
    assert convert(table, Rig, "c") == Rig(lenses=(Lens(fov=10.0), expected), by_side={"left": 1.0})


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        ("wid", 'c: lenses[1].preset: expected one of wide, plain, found "wid" (did you mean'),
        (
            {"preset": "wide", "fov": 70.0},
            "c: lenses[1].preset: expected centre beside fov, since that of wide belongs to its "
            "own fov, found none",
        ),
        ({"size": "tny"}, 'c: lenses[1].size.preset: expected one of tiny, found "tny"'),
        (3, "c.lenses[1]: expected a table"),
        ({"preset": 3}, "c.lenses[1].preset: expected a text"),
    ],
    ids=str,
)
def test_a_preset_that_is_none_or_does_not_fit_is_named_with_its_place(
    lens: Any, said: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        convert({"lenses": [{}, lens]}, Rig, "c")
    assert said in str(caught.value)


def test_a_presets_name_is_enough_where_nothing_else_is_required() -> None:
    assert by_name_alone(Lens) == ["wide", "plain"]
    assert by_name_alone(Required) == []
    assert by_name_alone(Rig) == []


def test_a_file_read_as_another_format_is_read_by_that_alone(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("no TOML")
    config = load(file, ["run.seed=3"], lambda text, name: {"run": {"name": text}, "nodes": [NODE]})
    assert (config.run.name, config.run.seed) == ("no TOML", 3)
