"""Typed settings of a whole file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from runtime.channels.links import LinkConfig
from runtime.node import Node, NodeConfig
from runtime.paths import InputPath, Secret
from runtime.units import Duration, plain

OnError = Literal["stop", "restart", "drop"]


class RunConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[run]`` table.

    Attributes:
        name: Names the folder of results, ``runs/<name>/<time>``.
        clock: ``lockstep`` (simulated time, reproducible) or ``real``.
        speed: Seconds of the clock per real second; ``max`` (lockstep only) is as fast as it can.
        seed: Of every random number in the run.
        duration: Seconds of the clock after which the run ends; 0 for no limit.
        digest: Whether to fingerprint all events; if not given, in lockstep only, since no two
            runs in real time are alike.
        stall: Real seconds without a turn of the loop that the watchdog reports; 0 for none.
        startup_limit: Real seconds a node's `on_startup`, or `on_ready`, may take.
        shutdown_limit: Real seconds a node's `on_shutdown` may take, and a twentieth of the run's
            length more.
        progress_limit: Real seconds without progress after which the log says who is waited for,
            and again after twice, four times… as long; 0 for never.
        log: Least level that is logged: trace, debug, info, warning, error or fatal.
        accept: Findings of ``lint`` that are meant: names of rules, or ``rule:source``.
    """

    name: str = "run"
    clock: Literal["lockstep", "real"] = "lockstep"
    speed: Annotated[float, msgspec.Meta(gt=0)] | Literal["max"] | None = None
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    duration: Duration = Duration(0)  # immutable
    digest: bool | None = None
    stall: Duration = Duration(0.02)
    startup_limit: Duration = Duration(60)
    shutdown_limit: Duration = Duration(10)
    progress_limit: Duration = Duration(5)
    log: Literal["trace", "debug", "info", "warning", "error", "fatal"] = "info"
    accept: tuple[str, ...] = ()


class NetworkConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[network]`` table: how the processes of a run with ``--only`` find each other.

    Attributes:
        meet: A Zenoh endpoint at which they meet. Whichever process on its host comes first listens
            there; the others connect to it. By default on this machine only.
        zenoh: A Zenoh configuration file, which then says where to listen and connect instead, and
            who may: for TLS, access control, a router.
        secret: Only who knows it may take part: ``env:NAME`` (of a variable), ``file:PATH``, or at
            least 16 characters. Without it, a random key in a private file of this user, which
            serves on one machine.
        shared: Whether large events to a process on this machine pass through memory that both see.
        lease: A process that is silent for so long is gone.
        wait: How long to wait for the others at the start.
    """

    meet: str = "tcp/127.0.0.1:7450"
    zenoh: InputPath = ""
    secret: Secret = ""
    shared: bool = True
    lease: Duration = Duration(0.8)  # immutable
    wait: Duration = Duration(60)


class NodeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """A ``[[nodes]]`` table.

    Attributes:
        type_name: As in the file: a listed node's name, or ``module:Class``.
        on_error: Effect of an exception in the node on the run.
    """

    name: str
    type_name: str
    on_error: OnError
    inputs: dict[str, str]
    links: dict[str, LinkConfig]
    node: type[Node[Any]]
    config: NodeConfig


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """A whole file."""

    run: RunConfig
    nodes: tuple[NodeSpec, ...]
    network: NetworkConfig = NetworkConfig()


def to_builtins(config: Config) -> dict[str, Any]:
    """Return all settings, defaults included, as `load` would read them; but no secret."""
    nodes = []
    for spec in config.nodes:
        head = {"name": spec.name, "type": spec.type_name, "on_error": spec.on_error}
        if spec.inputs:
            head["inputs"] = spec.inputs  # type: ignore[assignment]
        if spec.links:
            head["links"] = msgspec.to_builtins(spec.links, enc_hook=plain)
        nodes.append(head | msgspec.to_builtins(spec.config, enc_hook=plain))
    table: dict[str, Any] = {"run": msgspec.to_builtins(config.run, enc_hook=plain)}
    if config.network != NetworkConfig():
        network = msgspec.to_builtins(config.network, enc_hook=plain)
        if not network["secret"].startswith(("env:", "file:")):
            del network["secret"]
        table["network"] = network
    return without_none(table | {"nodes": nodes})  # type: ignore[no-any-return]


def without_none(value: Any) -> Any:
    """Return a value without unset entries (`None`): TOML has no null."""
    if isinstance(value, dict):
        return {k: without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [without_none(v) for v in value]
    return value
