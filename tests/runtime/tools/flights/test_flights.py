"""A flight that is played again is, to all who watch it, the flight itself."""

from __future__ import annotations

import io
import os
import threading
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import xxhash
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from runtime.channels.wire import Digest
from runtime.config.model import Config
from runtime.config.reading import load
from runtime.errors import NodeError
from runtime.tools.flights import (
    content_key,
    flight_of,
    fly,
    home,
    read_object,
    recorded,
    remove_beyond,
    settings_key,
    stored,
    write_object,
)
from tests.runtime.tools.flights import samples
from tests.runtime.tools.flights.samples import Seen, events_of, flown
from tests.runtime.tools.samples_cli import ROOT


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def assert_equal_when_played(
    folder: Path, *overrides: str, flight: tuple[str, ...] = (), run: str = "duration = '3s'"
) -> None:
    """Fly, and play a flight recorded with other settings of what does not fly."""
    config = flown(folder, *overrides, *flight, run=run)
    summary, lines = events_of(config)
    assert recorded(flown(folder, *flight, run=run), record=True)
    again, same_lines = events_of(config, watch=recorded(config, record=False))
    assert (set(summary.workers), set(again.workers)) == ({"craft.Lens"}, set())
    assert same_lines == lines
    assert len(lines) > 100
    for field in (
        "digest",
        "digests",
        "verdict",
        "reason",
        "sim_seconds",
        "announcements",
        "outputs",
    ):
        assert getattr(again, field) == getattr(summary, field), field
    assert again.environment["craft"] == "nothing to be seen"
    ticks = {name: tick.calls for name, tick in summary.ticks.items()}
    assert {name: tick.calls for name, tick in again.ticks.items()} == ticks


@pytest.mark.slow
@settings(
    max_examples=5,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    st.sampled_from([20, 33.3, 50, 100]),
    st.sampled_from(["0ms", "5ms", "20ms", "40ms", "70ms"]),
    st.sampled_from(["0ms", "10ms", "20ms", "40ms"]),
    st.sampled_from(["0ms", "20ms", "30ms"]),
)
def test_a_played_flight_is_equal_to_the_event_and_in_their_order(
    tmp_path: Path, rate: float, latency: str, guess: str, before: str
) -> None:
    flight = (f"craft.rate={rate}", f"craft.latency={latency}")
    others = (f"guesser.latency={guess}", f"before.latency={before}")
    assert_equal_when_played(tmp_path, *others, flight=flight)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("others", "flight", "run"),
    [
        ((), (), "duration = '0.5s'"),  # it ends before the captain has gone
        ((), (), "duration = '3s'"),
        (("guesser.end=0.4",), (), "duration = '3s'"),  # another node ends it
        ((), ("craft.last_words=true",), "duration = '3s'"),
        (
            ("guesser.links.pairs.loss=0.2",),
            ("captain.links.felt.delay=7ms", "captain.links.seen.delay=13ms"),
            "duration = '3s'",
        ),
    ],
)
def test_it_ends_and_goes_by_its_links_as_it_did(
    tmp_path: Path, others: tuple[str, ...], flight: tuple[str, ...], run: str
) -> None:
    assert_equal_when_played(tmp_path, *others, flight=flight, run=run)


def test_what_else_has_an_influence_is_not_recorded(tmp_path: Path) -> None:
    meddler = "[[nodes]]\nname = 'meddler'\ntype = 'tests.runtime.tools.flights.samples:Meddler'\n"
    meddled = flown(tmp_path, text=meddler)
    assert flight_of(meddled) is None
    assert recorded(meddled, record=True) is None
    narrowed = flown(tmp_path, "craft.inputs.orders=captain", text=meddler)
    part = flight_of(narrowed)
    assert part is not None
    assert [spec.name for spec in part.nodes] == ["craft", "captain"]
    assert flight_of(flown(tmp_path, "run.clock=real")) is None
    assert flight_of(load(ROOT / "examples" / "closed_loop.toml")) is None
    process = ROOT / "examples" / "outside_cpp.toml"
    assert flight_of(load(process)) is not None
    assert flight_of(load(process, ["slam.pilot=true"])) is None
    tour = flight_of(load(ROOT / "config.toml"))
    assert tour is not None
    assert [spec.name for spec in tour.nodes] == ["drone", "pilot"]


@pytest.mark.slow
def test_flights_are_told_apart_by_what_they_depend_on(tmp_path: Path) -> None:
    def keys(*overrides: str) -> tuple[str, str]:
        part = flight_of(flown(tmp_path, *overrides))
        assert part is not None
        return settings_key(part), content_key(part)

    assert keys() == keys("guesser.latency=1ms", "run.log=error", "run.name=other")
    different = [keys(changes) for changes in ("craft.rate=20", "run.seed=9", "run.duration=2s")]
    assert len({*different, keys()}) == 4


@pytest.mark.slow
def test_the_key_knows_what_a_world_includes(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    mesh, part = tmp_path / "meshes" / "rock.obj", tmp_path / "part.xml"
    mesh.write_text("v 0 0 0")
    part.write_text(  # which includes itself, too: MuJoCo says so later
        '<mujoco><asset><mesh file="rock.obj"/></asset><include file="part.xml"/></mujoco>'
    )
    world = tmp_path / "world.xml"
    world.write_text('<mujoco><compiler meshdir="meshes"/><include file="part.xml"/></mujoco>')
    config = load(ROOT / "config.toml", [f"drone.world={world}"])
    flight = flight_of(config)
    assert flight is not None
    keys = {content_key(flight)}
    for file in (mesh, part, world):
        file.write_text(file.read_text() + "\n")
        keys.add(content_key(flight))
    assert len(keys) == 4


@pytest.mark.slow
def test_the_key_knows_modules_beside_a_node_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "beside_physics"
    package.mkdir()
    files = [tmp_path / "beside_craft.py", tmp_path / "beside_tools.py"]
    files += [package / name for name in ("__init__.py", "drag.py", "air.py")]
    texts = [
        "import beside_tools\nimport numpy as np\nfrom beside_physics import drag\n"
        "from tests.runtime.tools.flights.samples import Craft\nclass Own(Craft):\n    pass\n",
        "def tool():\n    from no_such_module import it\n",
        "",
        "from . import air\n",
        "DENSITY = 1.2\n",
    ]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    own = "[[nodes]]\nname = 'own'\ntype = 'beside_craft:Own'\n"
    part = flight_of(flown(tmp_path, text=own))
    assert part is not None
    keys = {content_key(part)}
    for file in files:
        file.write_text(file.read_text() + "# changed\n")
        keys.add(content_key(part))
    assert len(keys) == 1 + len(files)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["{}", ".{}.lock", ".{}.new", ""])
@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_what_has_a_name_of_the_cache_neither_hangs_nor_fails_a_run(
    kind: str, name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = flown(tmp_path, "captain.end=0.2", "craft.lens=false", run="duration = '0.3s'")
    part = flight_of(config)
    assert part is not None
    path = home() / name.format(f"{content_key(part)}.flight") if name else home()
    path.parent.mkdir(parents=True)
    os.mkfifo(path) if kind == "fifo" else path.mkdir()
    used = (kind, name) in {("fifo", ".{}.lock"), ("folder", "")}
    assert bool(recorded(config, record=True)) is used
    assert (f"found {path}: " in caplog.text) is not used
    remove_beyond(0.0)
    assert path.exists()


_OTHER_CODE = b"cevents\nNoLongerThere\n."  # a pickle that only other code can read


@pytest.mark.slow
@pytest.mark.parametrize("what", ["cut", "gone", "empty", "first", "middle", "last", "other code"])
def test_what_is_damaged_or_of_other_code_is_flown_again(tmp_path: Path, what: str) -> None:
    config = flown(tmp_path, "captain.end=0.2")
    recorded(config, record=True)
    (flight,) = stored()
    content = flight.path.read_bytes()
    place = {"first": 0, "middle": len(content) // 2, "last": -1}.get(what, 0)
    changed = bytearray(content)
    changed[place] ^= 1
    other = _OTHER_CODE + bytes(8)
    flight.path.write_bytes(
        {"cut": content[:-7], "empty": b"", "other code": other + xxhash.xxh3_128_digest(other)}
        .get(what, bytes(changed))
    )  # fmt: skip
    if what == "gone":
        flight.path.unlink()
    assert recorded(config, record=False) is None
    assert recorded(config, record=True)
    assert flight.path.read_bytes() == content


@pytest.mark.slow
def test_an_answer_that_other_code_has_written_is_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = flown(tmp_path, "captain.end=0.2")
    assert recorded(config, record=True)
    with monkeypatch.context() as patch:
        patch.delattr(samples, "Look")
        assert recorded(config, record=False) is None
    assert recorded(config, record=False)


@given(
    arrays(st.sampled_from(["u1", "<f4", ">f8", "<i2", "?"]), array_shapes(min_dims=0, min_side=0)),
    st.sampled_from([0, 1.5, np.float32(2), True]),
    st.booleans(),
)
def test_answers_come_back_with_their_very_types(
    data: npt.NDArray[np.uint8], number: float, transposed: bool
) -> None:
    sent = Seen(stamp=1, source="craft", number=number, data=data.T if transposed else data)
    file = io.BytesIO(b"")
    write_object(file, sent)
    place = write_object(file, sent)
    again = read_object(memoryview(file.getvalue()), place)
    assert type(again.number) is type(number)
    digests = [Digest(), Digest()]
    for digest, event in zip(digests, (sent, again), strict=True):
        digest(None, event)
    assert digests[0].hexdigest() == digests[1].hexdigest()


def test_calls_that_the_flight_does_not_know_are_an_error(tmp_path: Path) -> None:
    played = recorded(flown(tmp_path, "captain.end=0.1"), record=True)
    message = "worker craft.Lens: expected the calls of the recorded flight, next none, found mean"
    with pytest.raises(NodeError, match=message):
        events_of(flown(tmp_path, "captain.end=1.0"), watch=played)


@pytest.mark.slow
def test_a_flight_that_fails_is_not_kept(tmp_path: Path) -> None:
    config = flown(tmp_path, "craft.fail=true", "craft.lens=false")
    assert recorded(config, record=True) is None
    assert stored() == []
    with pytest.raises(NodeError, match="out of order"):
        events_of(config)


@pytest.mark.slow
def test_a_signal_during_the_flight_ends_what_was_to_follow(tmp_path: Path) -> None:
    config = flown(tmp_path, "craft.signal=true", "craft.lens=false")
    with pytest.raises(KeyboardInterrupt):
        recorded(config, record=True)
    assert stored() == []


@pytest.mark.slow
def test_one_flies_while_others_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = flown(tmp_path, "captain.end=0.2")
    flights = []

    def counted(config: Config, path: Path) -> None:
        flights.append(path)
        fly(config, path)

    monkeypatch.setattr("runtime.tools.flights.fly", counted)
    answers: list[bool] = []
    threads = [
        threading.Thread(target=lambda: answers.append(recorded(config, record=True) is not None))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == [True] * 3
    assert len(flights) == 1


@pytest.mark.slow
def test_those_not_used_for_longest_go_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configs = [flown(tmp_path, "captain.end=0.2", f"run.seed={seed}") for seed in range(3)]
    for config in configs:
        recorded(config, record=True)
    for age, flight in enumerate(stored()):
        os.utime(flight.path, (1000 - age, 1000 - age))
    newest, _, oldest = stored()
    used = next(c for c in configs if content_key(flight_of(c) or c) == oldest.path.stem)
    played = recorded(used, record=False)
    (removed,) = remove_beyond((oldest.size + newest.size + 9) / 1e9)
    assert removed.path not in {oldest.path, newest.path}
    assert [recording.path for recording in stored()] == [oldest.path, newest.path]
    remove_beyond(0)
    assert stored() == []
    summary, lines = events_of(used, watch=played)  # what is open stays
    assert (summary.error, len(lines) > 50) == (None, True)
    monkeypatch.setenv("VISNAV_FLIGHTS_GB", "0.000001")
    for config in configs:
        assert recorded(config, record=True)
    assert len(stored()) == 1
    assert {path.suffix for path in home().iterdir()} == {".flight", ".lock"}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("config.toml", 3),
        ("examples/two_drones.toml", 2),
        ("examples/lidar.toml", 2),
        ("examples/moving.toml", 2),
        ("examples/stereo_inertial.toml", 2),
    ],
)
def test_real_flights_are_played_to_the_byte(name: str, seconds: int) -> None:
    overrides = [f"run.duration={seconds}s", "run.startup_limit=10min"]  # of a busy machine
    config = load(ROOT / name, overrides)
    summary, lines = events_of(config)
    played = recorded(config, record=True)
    again, same_lines = events_of(config, watch=played)
    assert set(summary.workers) - set(again.workers)
    assert same_lines == lines
    assert (again.digests, again.verdict) == (summary.digests, summary.verdict)
