"""The table of methods: as documented, and whatever clients send in its arguments."""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import typing
from typing import Annotated, Any

import msgspec
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from extensions.airsim.tests.methods_table import HEADING, PAGE, methods, rewritten, rows
from extensions.airsim.tests.scripts import Caller, drone, with_script
from runtime.channels.wire import Digest
from runtime.testing import NodeResult
from visnav_airsim import wire
from visnav_airsim.server import AirsimServer
from visnav_airsim.server.methods import reason_unsupported


def test_the_page_has_all_methods_as_they_are() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == rewritten(page), "run python -m extensions.airsim.tests.methods_table"


def test_the_table_has_what_a_run_serves(tiny_world: str, monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[AirsimServer] = []
    begin = AirsimServer.run

    async def noted(self: AirsimServer) -> None:
        served.append(self)
        await begin(self)

    monkeypatch.setattr(AirsimServer, "run", noted)

    def script(airsim: Caller) -> None:
        assert airsim("ping")

    with_script(script, [drone(world=tiny_world)])
    assert {row.name for row in rows()} == {*served[0].table.methods}
    assert all(row.description.endswith(".") for row in rows())
    assert not any(reason_unsupported(row.name) for row in rows())


def test_a_page_without_the_heading_is_refused() -> None:
    with pytest.raises(ValueError, match=HEADING.strip()):
        rewritten("# Methods")


METHODS = methods()
OUT_OF_BOUNDS = {"simContinueForTime", "simContinueForFrames", "startRecording", "simPause"}
"""Methods that let time go on, which may take long, or write files."""

NUMBERS = st.one_of(
    st.floats(), st.integers(-(2**63), 2**64 - 1), st.floats(-10, 10), st.sampled_from([0, 1, -1])
)
NAMES = st.one_of(
    st.sampled_from(["", "drone"]), st.sampled_from(["0", "front_center", "ball", ".*"]), st.text()
)
ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, NAMES, st.binary(max_size=20)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.sampled_from(["x_val", "position", "is_rate", "?"]), inner, max_size=3),
    ),
    max_leaves=6,
)


def plausible(hint: Any) -> st.SearchStrategy[Any]:
    """Return values that a client may send for a parameter of this type, and often not of it."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return plausible(arguments[0])
    if origin in {list, tuple}:
        return st.lists(plausible(arguments[0]), max_size=4)
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        fields = typing.get_type_hints(hint)
        return st.fixed_dictionaries({}, optional={k: plausible(v) for k, v in fields.items()})
    return {float: NUMBERS, int: NUMBERS, bool: st.booleans(), str: NAMES}.get(hint, ANYTHING)


@st.composite
def calls(draw: st.DrawFn) -> tuple[str, list[Any]]:
    """Return a method of the table and arguments of which most fit."""
    name = draw(st.sampled_from(sorted(METHODS.keys() - OUT_OF_BOUNDS)))
    hints = METHODS[name].parameters.values()
    arguments = [draw(plausible(hint) if draw(st.integers(0, 9)) else ANYTHING) for hint in hints]
    return name, arguments[: len(arguments) - (not draw(st.integers(0, 9)))]


@st.composite
def mutated(draw: st.DrawFn) -> bytes:
    """Return a valid request of a method that only reads, of which a few bytes are others."""
    name = draw(st.sampled_from(["ping", "getMultirotorState", "simGetVehiclePose", "nothing"]))
    data = bytearray(wire.request(draw(st.integers(0, 9)), name, [draw(NAMES)]))
    for _ in range(draw(st.integers(0, 3))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return bytes(data)


def quickly(examples: int) -> settings:
    return settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )


def test_random_bytes_leave_the_run_as_it_is(tiny_world: str) -> None:
    def fly(*, attacked: bool) -> NodeResult:
        def script(airsim: Caller) -> None:
            @quickly(100)
            @given(st.lists(st.one_of(st.binary(max_size=60), mutated()), max_size=6))
            def attack(pieces: list[bytes]) -> None:
                address = airsim._socket.getpeername()
                with socket.create_connection(address) as client, contextlib.suppress(OSError):
                    for piece in pieces:
                        client.sendall(piece)
                    assert airsim("ping") is True

            airsim("simContinueForTime", 0.1)
            if attacked:
                attack()
            airsim("simContinueForTime", 0.1)

        return with_script(script, [drone(world=tiny_world)])

    digests = []
    for attacked in (False, True):
        digest = Digest()
        for event in fly(attacked=attacked).sent:
            digest(None, event)
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]


def _attack_methods(examples: int, world: str, caplog: pytest.LogCaptureFixture) -> None:
    def script(airsim: Caller) -> None:
        @quickly(examples)
        @given(st.lists(calls(), min_size=1, max_size=5))
        def attack(requests: list[tuple[str, list[Any]]]) -> None:
            airsim("enableApiControl", True, "")
            with contextlib.closing(Caller(airsim._socket.getpeername()[1])) as client:
                for name, arguments in requests:
                    client.send(name, *arguments)
                client("ping")
            airsim("simContinueForTime", 0.03)  # for tasks to steer
            position = airsim("simGetVehiclePose", "drone")["position"]
            assert all(map(math.isfinite, position.values())), requests

        attack()

    with caplog.at_level(logging.ERROR, logger="visnav"):
        with_script(script, [drone(world=world)])
    logged = [record.getMessage() for record in caplog.records]
    assert [text for text in logged if "bug of the server" in text] == []


def test_any_arguments_of_any_method_are_answered_or_refused(
    tiny_world: str, caplog: pytest.LogCaptureFixture
) -> None:
    _attack_methods(60, tiny_world, caplog)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_very_many_arguments_are(tiny_world: str, caplog: pytest.LogCaptureFixture) -> None:
    _attack_methods(1500, tiny_world, caplog)
