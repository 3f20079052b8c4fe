"""Typed settings of a whole file, their errors as place, expected and found, and changes of them.

A change is ``--set drone.cameras.front.rate=10``.
"""

from __future__ import annotations

import functools
import itertools
import re
import tomllib
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec

from runtime.channels.sender import LinkConfig
from runtime.errors import ConfigError, expect_known, suggest
from runtime.node import Node, NodeConfig
from runtime.paths import GivenHere, InputPath, Secret
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


_LONGEST_TEXT = 300  # most characters of a text shown in a message

_NAMES = {
    "float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false",
    "array": "a list", "object": "a table",
}  # fmt: skip


def explain(message: str, value: Any, type_: type[msgspec.Struct], where: str) -> str:
    """Rewrite a message of msgspec as place, expected, found."""
    text, _, path = message.partition(" - at `$")
    path = path.rstrip("`")
    place = where + path if not where.endswith(")") or not path else f"{where}: {path[1:]}"
    if match := re.fullmatch(r"Object contains unknown field `(.*)`", text):
        known = _fields_at(type_, path)
        problem = f"found unknown key {match[1]!r}" + suggest(match[1], known)
        return f"{place}: {problem}; expected one of {', '.join(known) or 'no settings'}"
    if match := re.fullmatch(r"Object missing required field `(.*)`", text):
        return f"{place}: expected a setting {show(match[1])}, found none"
    if "found" in text:  # a check of our own, which has said it all
        return f"{place}: {text}"
    if text.startswith("Invalid enum value"):
        text = "expected " + " or ".join(_choices(_type_at(type_, path)))
    expected = re.sub(r", got .*", "", text)
    expected = re.sub(r"`([\w| ]+)`", lambda match: _translate(match[1]), expected)
    expected = re.sub(r"(\d)\.0\b", r"\1", expected)
    expected = expected.replace("matching regex '", "that matches '")
    expected = expected[0].lower() + expected[1:]
    return f"{place}: {expected}, found {show(_at(value, path))}"


def _translate(types: str) -> str:
    return " or ".join(_NAMES.get(name, name) for name in types.split(" | ") if name != "null")


def _choices(type_: Any) -> list[str]:
    if get_origin(type_) is Literal:
        return [show(value) for value in get_args(type_)]
    if get_args(type_):
        return [choice for inner in get_args(type_) for choice in _choices(inner)]
    name = getattr(type_, "__name__", "")
    return [_NAMES[name]] if name in _NAMES else []


def _at(value: Any, path: str) -> Any:
    """Return the value at a path such as ``.cameras[0].rate``."""
    for name, index in re.findall(r"\.([\w-]+)|\[(\d+)\]", path):
        try:
            value = value[name] if name else value[int(index)]
        except (KeyError, IndexError, TypeError):
            return value
    return value


def _fields_at(type_: Any, path: str) -> list[str]:
    struct = struct_in(_type_at(type_, path))
    return [] if struct is None else list(struct.__struct_encode_fields__)


def _type_at(type_: Any, path: str) -> Any:
    for name in re.findall(r"\.([\w-]+)", path):
        struct = struct_in(type_)
        type_ = None if struct is None else types_of(struct).get(name)
    return type_


@functools.cache  # reading annotations takes some tenths of a millisecond
def types_of(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the types of a struct's fields by their keys in the file."""
    return {field.encode_name: field.type for field in msgspec.structs.fields(struct)}


def struct_in(type_: Any) -> type[msgspec.Struct] | None:
    """Return the struct behind a type: the type itself, or of a list's entries."""
    while type_ is not None and not hasattr(type_, "__struct_fields__"):
        type_ = next(iter(get_args(type_)), None)
    return type_  # type: ignore[no-any-return]


def show(value: Any) -> str:
    """Format a value as in the file, on a single line, shortened."""
    if isinstance(value, str):
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in value[:_LONGEST_TEXT])
        return f'"{text}"' if len(value) <= _LONGEST_TEXT else f'"{text}..."'
    if isinstance(value, bool):
        return str(value).lower()
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def override(table: dict[str, Any], change: str) -> None:
    """Change a single setting of a table given by `tomllib`.

    Args:
        change: ``node.key=value`` or ``run.key=value``; the value in TOML, or a bare word.
            ``front.rate`` is short for ``drone.cameras.front.rate``, if nothing else has that name.

    Raises:
        ConfigError: There is no such node, or nothing to set there.
    """
    path, equals, text = change.partition("=")
    keys = path.strip().split(".")
    where = f"--set {show(change)[1:-1]}"
    if not equals or len(keys) < 2 or not all(keys):
        raise ConfigError(f"{where}: expected node.key=value or run.key=value")
    try:
        value = given(text)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    nodes = _by_name(table.get("nodes"))
    if keys[0] in {"run", "network"}:
        target = table.setdefault(keys[0], {})
    elif keys[0] in nodes:
        target = nodes[keys[0]]
    else:
        target = _part(nodes, keys[0], where)
    for before, key in itertools.pairwise(keys[:-1]):
        if isinstance(target, list):  # an entry of a list of tables, by its name
            target = _entry(target, key, f"{where}: {before}")
        elif isinstance(target, dict):
            target = target.setdefault(key, {})
    if isinstance(target, list):
        _entry(target, keys[-1], f"{where}: {keys[-2]}")
    if not isinstance(target, dict):
        raise ConfigError(
            f"{where}: {keys[-2]}: expected a table, since .{keys[-1]} follows, "
            f"found {show(target)}"
        )
    target[keys[-1]] = value


def given(text: str) -> Any:
    """Return a command-line text's value in TOML, or the text; else raise `ValueError`."""
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return GivenHere(text.strip())
    except ValueError:  # of Python's int()
        raise ValueError("expected a number of a usual size") from None
    except RecursionError:
        raise ValueError("expected a value, found brackets nested too deep") from None
    if len(table) > 1:
        raise ValueError("expected one setting, found more lines")
    value = table["value"]
    return GivenHere(value) if isinstance(value, str) else value


def _part(nodes: dict[str, dict[str, Any]], name: str, where: str) -> dict[str, Any]:
    """Return the only table of this name in the lists of all nodes, such as a camera's."""
    parts = {
        f"{node}.{key}.{part}": entry
        for node, table in nodes.items()
        for key, entries in table.items()
        for part, entry in _by_name(entries).items()
    }
    matches = [path for path in parts if path.endswith(f".{name}")]
    if len(matches) == 1:
        return parts[matches[0]]
    if matches:
        raise ConfigError(f"{where}: expected one of {', '.join(matches)}; found {show(name)}")
    known = ["run", *nodes, *(path.rpartition(".")[2] for path in parts)]
    raise ConfigError(
        f"{where}: expected run or a node ({', '.join(nodes)}), found {show(name)}"
        + suggest(name, known)
    )


def _entry(entries: list[Any], name: str, where: str) -> dict[str, Any]:
    named = _by_name(entries)
    listed = ", ".join(named) or "a table with a name"
    expect_known(name, named, f"{where}: expected one of {listed}; found {show(name)}")
    return named[name]


def _by_name(entries: Any) -> dict[str, dict[str, Any]]:
    tables = [e for e in entries if isinstance(e, dict)] if isinstance(entries, list) else []
    return {str(table["name"]): table for table in tables if "name" in table}
