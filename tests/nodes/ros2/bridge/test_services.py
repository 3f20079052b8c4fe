"""Services as a plain Zenoh session asks them: keys, attachments, replies, and what is refused."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterable
from typing import Any

import pytest
import zenoh

from events import (
    Announcement,
    Arm,
    Armed,
    Command,
    Disarm,
    Disarmed,
    Land,
    Landed,
    TakenOff,
    Takeoff,
    VehicleEvent,
)
from nodes.ros2.bridge.keys import SIZE, Attachment, pack, unpack
from nodes.ros2.bridge.node import Ros2Bridge
from nodes.ros2.bridge.services import WAITING
from nodes.ros2.messages.topics import DEFINITIONS, SIMULATION, TRIGGER
from nodes.ros2.messages.typestore import TypeStore
from runtime import Node, Output, on
from runtime.config.model import Config, NodeSpec, RunConfig
from runtime.errors import ConfigError, FatalError
from runtime.run.execute import execute
from runtime.testing import NodeResult, run_node, run_nodes, spec
from tests.nodes.ros2.bridge.network import free_port, zenoh_session
from tests.nodes.ros2.messages import samples

STORE = TypeStore()
for _type, _definition in DEFINITIONS.items():
    STORE.add(_type, _definition)
GID = bytes(range(16))


class Vehicle(Node):
    """Obeys what it is told half a second later; it does not take off while it is not armed."""

    vehicle_events = Output(VehicleEvent)

    def announce(self) -> Iterable[Announcement]:
        return [samples.vehicle()]

    @on(Command)
    def commands(self, command: Command) -> None:
        told = {Arm: Armed, Disarm: Disarmed, Takeoff: TakenOff, Land: Landed}[type(command)]
        self.start(self.tell(told))

    async def tell(self, told: type[VehicleEvent]) -> None:
        await self.clock.sleep(0.5)
        self.vehicle_events.send(told(stamp=self.clock.now(), source="drone"))
        if told is Landed:
            self.vehicle_events.send(Disarmed(stamp=self.clock.now(), source="drone"))


class Client:
    """Asks services, in a thread beside a run."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.keys: dict[str, str] = {}
        self._there = threading.Condition()
        self._watch = session.liveliness().declare_subscriber(
            "@ros2_lv/0/*/*/*/SS/**", self._declared, history=True
        )
        self.sequence = 0
        self.over = False

    def _declared(self, sample: zenoh.Sample) -> None:
        *_, name, type_, hash_, _ = str(sample.key_expr).split("/")
        with self._there:
            self.keys[name.replace("%", "/")] = f"{type_}/{hash_}"
            self._there.notify_all()

    def key(self, name: str) -> str:
        with self._there:
            assert self._there.wait_for(lambda: name in self.keys, 20.0), self.keys
        return f"0{name}/{self.keys[name]}"

    def ask(self, name: str, payload: bytes | None, attachment: bytes | None) -> list[Any]:
        replies = self.session.get(
            self.key(name),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=payload,
            attachment=attachment,
            timeout=20.0,
        )
        return list(replies)

    def call(self, name: str, type_: str, **fields: Any) -> Any:
        """Return the response, or the text of an error reply."""
        self.sequence += 1
        request = STORE.message(f"{type_}_Request")(**fields)
        attachment = Attachment(self.sequence, 7, GID)
        (reply,) = self.ask(name, bytes(STORE.serialize(request)), pack(attachment))
        if reply.err is not None:
            return reply.err.payload.to_string()
        echoed = unpack(reply.ok.attachment.to_bytes())
        assert (echoed.sequence, echoed.gid) == (self.sequence, GID)
        assert echoed.stamp > 1_700_000_000_000_000_000
        assert str(reply.ok.key_expr) == self.key(name)
        return STORE.deserialize(reply.ok.payload.to_bytes(), f"{type_}_Response")

    def trigger(self, name: str) -> tuple[bool, str]:
        response = self.call(name, TRIGGER)
        return response.success, response.message

    def set_state(self, state: int) -> int:
        wanted = STORE.message("simulation_interfaces/msg/SimulationState")(state=state)
        type_ = f"{SIMULATION}/SetSimulationState"
        result: int = self.call("/set_simulation_state", type_, state=wanted).result.result
        return result

    def state(self) -> int:
        response = self.call("/get_simulation_state", f"{SIMULATION}/GetSimulationState")
        state: int = response.state.state
        return state

    def step(self, steps: int) -> tuple[int, str]:
        type_ = f"{SIMULATION}/StepSimulation"
        result = self.call("/step_simulation", type_, steps=steps).result
        return result.result, result.error_message


def simulated(nodes: list[NodeSpec]) -> NodeResult:
    return run_nodes(nodes, duration=1e6)


def driven(
    drive: Callable[[Client], None],
    vehicle: type[Vehicle] = Vehicle,
    run: Callable[[list[NodeSpec]], Any] = simulated,
    **config: Any,
) -> Any:
    """Run a vehicle and the bridge while a client drives them from a thread."""
    locator = f"tcp/127.0.0.1:{free_port()}"
    failed: list[BaseException] = []

    def guarded(client: Client) -> None:
        try:
            drive(client)
        except BaseException as error:
            failed.append(error)
        finally:
            if not client.over:
                client.set_state(0)

    settings = {"connect": [locator], "listen": [], "services": ["simulation", "vehicle"]}
    settings |= {"paused": True} | config
    with zenoh_session(listen=locator) as session:
        thread = threading.Thread(target=guarded, args=(Client(session),))
        thread.start()
        result = run([spec(vehicle, "vehicle"), spec(Ros2Bridge, "ros2", settings)])
        thread.join()
    if failed:
        raise failed[0]
    return result


@pytest.mark.parametrize(
    ("type_", "definition", "expected"),
    [
        (
            TRIGGER,
            DEFINITIONS[TRIGGER],
            "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
        ),
        (
            "example_interfaces/srv/AddTwoInts",  # rmw_zenoh, docs/design.md
            "int64 a\nint64 b\n---\nint64 sum",
            "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
        ),
    ],
)
def test_services_have_the_hashes_that_ros_gives_them(
    type_: str, definition: str, expected: str
) -> None:
    store = TypeStore()
    store.add(type_, definition)
    assert store.hash(type_) == expected
    humble = TypeStore("humble")
    humble.add(type_, definition)
    assert humble.hash(type_) == "TypeHashNotSupported"


@pytest.mark.slow
def test_time_is_paused_stepped_and_resumed_by_services() -> None:
    def drive(client: Client) -> None:
        features = client.call("/get_simulator_features", f"{SIMULATION}/GetSimulatorFeatures")
        assert features.features.features.tolist() == [24, 25, 26, 31, 32, 33]
        assert features.features.custom_info == "a step is 0.002 s of simulated time"
        assert client.state() == 2
        assert client.set_state(2) == 101
        assert client.step(250) == (1, "")
        assert client.step(0)[0] == client.step(2**64 - 1)[0] == 4
        assert client.state() == 2
        assert client.set_state(1) == 1
        assert client.state() == 1
        assert client.step(1) == (4, "expected time to stand, found it running")
        assert client.set_state(1) == 101
        assert client.set_state(4) == client.set_state(200) == 103
        assert client.set_state(2) == 1
        reset = client.call("/reset_simulation", f"{SIMULATION}/ResetSimulation", scope=255)
        assert reset.result.result == 0
        assert "a run begins once" in reset.result.error_message

    assert driven(drive, step="2ms").reason == "ended by ROS"


@pytest.mark.slow
def test_time_that_is_real_is_neither_paused_nor_stepped() -> None:
    def drive(client: Client) -> None:
        features = client.call("/get_simulator_features", f"{SIMULATION}/GetSimulatorFeatures")
        assert features.features.features.tolist() == [24, 25]
        assert client.set_state(1) == 101
        assert client.set_state(2) == 0
        assert client.step(1) == (0, features.features.custom_info)
        assert "the run is in real time" in features.features.custom_info

    def run(nodes: list[NodeSpec]) -> str:
        return execute(Config(run=RunConfig(clock="real"), nodes=tuple(nodes))).reason

    assert driven(drive, run=run, paused=False) == "ended by ROS"


@pytest.mark.slow
def test_a_step_ends_at_exactly_its_time() -> None:
    def drive(client: Client) -> None:
        assert client.trigger("/drone/arm") == (True, "Arm is sent; time stands")
        assert client.step(499) == (1, "")
        assert client.trigger("/drone/disarm") == (True, "drone is disarmed already")
        assert client.step(1) == (1, "")
        assert client.trigger("/drone/disarm") == (True, "Disarm is sent; time stands")

    result = driven(drive)
    commands = [(type(command), command.stamp) for command in result.of(Command)]
    assert commands == [(Arm, 0), (Disarm, 500_000_000)]
    assert result.seconds == 0.5


@pytest.mark.slow
def test_vehicles_are_armed_take_off_and_land_and_the_reply_says_so() -> None:
    def drive(client: Client) -> None:
        assert client.set_state(1) == 1
        assert client.trigger("/drone/land") == (True, "drone is disarmed already")
        assert client.trigger("/drone/arm") == (True, "Armed")
        assert client.trigger("/drone/arm") == (True, "drone is armed already")
        assert client.trigger("/drone/take_off") == (True, "TakenOff")
        assert client.trigger("/drone/land") == (True, "Landed")
        assert client.set_state(2) == 1

    commands = driven(drive).of(Command)
    assert [type(command) for command in commands] == [Arm, Takeoff, Land]
    assert {(command.vehicle, command.source) for command in commands} == {("drone", "ros2")}


@pytest.mark.slow
def test_a_vehicle_that_does_not_obey_is_told_of() -> None:
    class Deaf(Vehicle):
        async def tell(self, told: type[VehicleEvent]) -> None:
            pass

    def drive(client: Client) -> None:
        assert client.trigger("/drone/arm") == (False, "drone did not say Armed within 1 s of Arm")
        assert client.trigger("/drone/take_off") == (
            False,
            "drone did not say TakenOff within 60 s of Takeoff",
        )

    driven(drive, Deaf, paused=False)


@pytest.mark.slow
def test_what_is_no_request_gets_an_error_and_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    good = pack(Attachment(1, 2, GID))
    step = bytes(STORE.serialize(STORE.message(f"{SIMULATION}/StepSimulation_Request")(steps=1)))
    wrong: list[tuple[bytes | None, bytes | None]] = [
        (None, good),
        (b"", good),
        (b"\x00\x01\x00\x00\xff", good),
        (step[:-1], good),
        (step, None),
        (step, good[:-1]),
        (step, b"\x00" * SIZE),
        (step + bytes(1 << 20), good),
    ]

    def drive(client: Client) -> None:
        for payload, attachment in wrong:
            (reply,) = client.ask("/step_simulation", payload, attachment)
            assert reply.ok is None
            assert reply.err.payload.to_string().startswith("expected ")
        assert client.step(1) == (1, "")  # and it goes on

    caplog.set_level(logging.INFO, "visnav")
    result = driven(drive, max_message_size=1 << 16)
    assert result.reason == "ended by ROS"
    assert f"{len(wrong)} refused or dropped" in caplog.text


@pytest.mark.slow
def test_a_flood_of_requests_is_refused_beyond_some_and_all_get_a_reply() -> None:
    def drive(client: Client) -> None:
        assert client.set_state(1) == 1
        key, request = (
            client.key("/drone/take_off"),
            bytes(STORE.serialize(STORE.zero(f"{TRIGGER}_Request"))),
        )
        asked = [
            client.session.get(
                key, payload=request, attachment=pack(Attachment(n, 0, GID)), timeout=20.0
            )
            for n in range(4 * WAITING)
        ]
        replies = [list(query) for query in asked]
        assert {len(answers) for answers in replies} == {1}
        sequences = [unpack(bytes(r.ok.attachment or b"")).sequence for (r,) in replies if r.ok]
        assert len(sequences) == len(set(sequences)) >= 1
        assert all(
            "requests that wait" in r.err.payload.to_string()
            for (r,) in replies
            if r.err is not None
        )
        assert client.set_state(2) == 1

    driven(drive)


@pytest.mark.slow
def test_who_waits_when_the_run_ends_is_told_so() -> None:
    paused = threading.Event()
    replies: list[Any] = []

    class Stopping(Vehicle):
        async def tell(self, told: type[VehicleEvent]) -> None:
            self.stepping.pause()
            paused.set()

    def drive(client: Client) -> None:
        waits = threading.Thread(
            target=lambda: replies.append(client.call("/drone/arm", TRIGGER)), daemon=True
        )
        waits.start()
        assert paused.wait(20.0)
        assert client.set_state(3) == 1
        waits.join(20.0)
        client.over = True

    driven(drive, Stopping, paused=False)
    assert replies == ["the run has ended"]


def test_no_service_is_there_unless_it_is_wanted() -> None:
    locator = f"tcp/127.0.0.1:{free_port()}"
    with zenoh_session(listen=locator) as session:
        tokens: queue.SimpleQueue[str] = queue.SimpleQueue()
        session.liveliness().declare_subscriber(
            "@ros2_lv/**", lambda sample: tokens.put(str(sample.key_expr))
        )
        result = run_node(
            Ros2Bridge,
            inputs=[samples.vehicle()],
            config={"connect": [locator], "listen": []},
            duration=0.1,
        )
        keys = [tokens.get(timeout=10)]
    while not tokens.empty():
        keys.append(tokens.get())
    assert result.of(Command) == []
    assert not [key for key in keys if "/SS/" in key]


@pytest.mark.parametrize(
    ("config", "why"),
    [
        ({"paused": True}, "paused: expected services"),
        ({"services": ["vehicle"], "paused": True}, "paused: expected services"),
        ({"services": ["simulation"], "keys": "ros2dds"}, "services: expected keys"),
        ({"step": 0}, "step: expected 1 ns or more"),
        ({"services": ["everything"]}, 'expected "simulation" or "vehicle"'),
    ],
)
def test_settings_that_make_no_sense_are_refused(config: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        spec(Ros2Bridge, "ros2", config)


def test_runs_in_real_time_cannot_begin_paused() -> None:
    config = {"services": ["simulation"], "paused": True, "connect": [], "listen": []}
    run = RunConfig(clock="real")
    with pytest.raises(FatalError, match="paused: the run is in real time"):
        execute(Config(run=run, nodes=(spec(Ros2Bridge, "ros2", config),)))
