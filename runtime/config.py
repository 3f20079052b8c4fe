"""From a TOML file to typed settings, with errors that say where, what was expected and found.

[run]                                   # -> RunConfig
clock = "lockstep"

[[nodes]]                               # -> NodeSpec, one a node, in order
name = "drone"
type = "sims.multirotor:Multirotor"     # module:Class
on_error = "stop"                       # optional, like `inputs`
inputs = { setpoints = "tour" }         # narrow a port to a source
rate = 30                               # all other keys: the node's own settings
"""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from runtime.errors import ConfigError, suggest
from runtime.node import Node, NodeConfig
from runtime.ports import MAX_HZ
from runtime.units import Duration

S = TypeVar("S", bound=msgspec.Struct)

OnError = Literal["stop", "restart", "drop"]


class RunConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[run]`` table.

    Attributes:
        name: Names the folder of results, ``runs/<name>``.
        clock: ``lockstep`` (simulated time, reproducible) or ``real``.
        speed: Seconds of the clock per real second; ``max`` (lockstep only) is as fast as it can.
        seed: Of every random number in the run.
        duration: Seconds of the clock after which the run ends; 0 for no limit.
        stall: Real seconds without a turn of the loop that the watchdog reports.
        startup_limit: Real seconds a node's `on_startup` may take.
        shutdown_limit: Real seconds a node's `on_shutdown` may take.
        log: Least level that is logged: trace, debug, info, warning, error or fatal.
    """

    name: str = "run"
    clock: Literal["lockstep", "real"] = "lockstep"
    speed: Annotated[float, msgspec.Meta(gt=0)] | Literal["max"] | None = None
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    duration: Duration = Duration(0)  # immutable
    stall: Duration = Duration(0.02)
    startup_limit: Duration = Duration(60)
    shutdown_limit: Duration = Duration(10)
    log: Literal["trace", "debug", "info", "warning", "error", "fatal"] = "info"


class NodeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One ``[[nodes]]`` table.

    Attributes:
        name: Unique in the file.
        type_name: ``module:Class``.
        on_error: What an exception in the node does to the run.
        inputs: Port or handler to the source it is narrowed to.
        node: The class.
        config: The node's own settings.
    """

    name: str
    type_name: str
    on_error: OnError
    inputs: dict[str, str]
    node: type[Node[Any]]
    config: NodeConfig


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """A whole file."""

    run: RunConfig
    nodes: tuple[NodeSpec, ...]


class _NodeHead(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    type: str
    on_error: OnError = "stop"
    inputs: dict[str, str] = {}


def load(path: Path, overrides: Sequence[str] = ()) -> Config:
    """Read a file.

    Args:
        path: The TOML file; its folder is where modules of its nodes are looked for, too.
        overrides: ``node.key=value`` or ``run.key=value``; the value in TOML, or a bare word.

    Raises:
        ConfigError: Something in it is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: expected UTF-8 text, found {error.reason}") from None
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: expected TOML, found: {error}") from None
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    for override in overrides:
        _override(table, override)
    return parse(table, path.name)


def parse(table: Mapping[str, Any], where: str) -> Config:
    """Turn a table, as `tomllib` gives it, into settings.

    Raises:
        ConfigError: Something in it is wrong; `where` begins the message.
    """
    for key in table:
        if key not in {"run", "nodes"}:
            raise ConfigError(
                f"{where}: expected tables [run] and [[nodes]], found {key!r}"
                + suggest(key, ["run", "nodes"])
            )
    run = convert(table.get("run", {}), RunConfig, f"{where}: run")
    if run.clock == "real" and run.speed == "max":
        raise ConfigError(f'{where}: run.speed: expected a number with clock "real", found "max"')
    nodes = table.get("nodes", [])
    if not isinstance(nodes, list) or not nodes:
        raise ConfigError(f"{where}: nodes: expected at least one [[nodes]] table, found none")
    specs: list[NodeSpec] = []
    for index, entry in enumerate(nodes):
        spec = _node(entry, f"{where}: nodes[{index}]")
        if spec.name in {other.name for other in specs}:
            raise ConfigError(
                f"{where}: nodes[{index}].name: expected a name of its own, "
                f"found {spec.name!r} a second time"
            )
        specs.append(spec)
    return Config(run=run, nodes=tuple(specs))


def find_node(type_: str, where: str) -> type[Node[Any]]:
    """Import the class that ``module:Class`` names.

    Raises:
        ConfigError: There is no such module or class, or it is not a node.
    """
    module_name, _, class_name = type_.partition(":")
    if not re.fullmatch(r"[\w.]+:\w+", type_):
        raise ConfigError(f'{where}: expected "module:Class", found {type_!r}')
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not module_name.startswith(error.name):
            raise ConfigError(f"{where}: {module_name} needs a module {error.name!r}") from error
        raise ConfigError(
            f"{where}: expected a module that can be imported, found {module_name!r}"
            + suggest(module_name, _known_modules())
        ) from None
    found = getattr(module, class_name, None)
    known = [n for n, v in vars(module).items() if isinstance(v, type) and issubclass(v, Node)]
    if not (isinstance(found, type) and issubclass(found, Node)):
        raise ConfigError(
            f"{where}: expected a node of {module_name}, found {class_name!r}"
            + suggest(class_name, known)
        )
    return found


def convert(value: Any, type_: type[S], where: str) -> S:
    """Turn a table into a struct.

    Raises:
        ConfigError: A key is unknown or missing, or a value is of the wrong type or size.
    """
    try:
        return msgspec.convert(value, type_, dec_hook=_decode)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error), value, type_, where)) from None


def to_builtins(config: Config) -> dict[str, Any]:
    """Return all settings, defaults included, as `load` would read them."""
    nodes = []
    for spec in config.nodes:
        head = {"name": spec.name, "type": spec.type_name, "on_error": spec.on_error}
        if spec.inputs:
            head["inputs"] = spec.inputs  # type: ignore[assignment]
        nodes.append(head | msgspec.to_builtins(spec.config, enc_hook=float))
    table: dict[str, Any] = _without_none(
        {"run": msgspec.to_builtins(config.run, enc_hook=float), "nodes": nodes}
    )
    return table


def _without_none(value: Any) -> Any:
    """Leave out what is not set: TOML has no null."""
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return value


def _node(entry: Any, where: str) -> NodeSpec:
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: expected a table, found {_show(entry)}")
    keys = {f.name for f in msgspec.structs.fields(_NodeHead)}
    head = convert({k: v for k, v in entry.items() if k in keys}, _NodeHead, where)
    if not re.fullmatch(r"[A-Za-z_][\w-]*", head.name):
        raise ConfigError(f"{where}.name: expected letters, digits, _ and -, found {head.name!r}")
    if head.name == "run":
        raise ConfigError(f'{where}.name: expected any name but "run", which is the run itself')
    cls = find_node(head.type, f"{where}.type")
    rest = {k: v for k, v in entry.items() if k not in keys}
    config = convert(rest, cls.config_type, where)
    for port in head.inputs:
        if port not in cls.declared.listening:
            raise ConfigError(
                f"{where}.inputs: expected an input or handler of {head.type}, found {port!r}"
                + suggest(port, cls.declared.listening)
            )
    for method, ticks in cls.declared.ticks.items():
        if isinstance(ticks.hz, str):
            rate = getattr(config, ticks.hz, None)
            if not isinstance(rate, int | float) or not 0 < rate <= MAX_HZ:
                raise ConfigError(
                    f"{where}.{ticks.hz}: expected a rate above 0, up to {MAX_HZ} Hz, "
                    f"for {method}, found {_show(rate)}"
                )
    return NodeSpec(
        name=head.name,
        type_name=head.type,
        on_error=head.on_error,
        inputs=head.inputs,
        node=cls,
        config=config,
    )


def _override(table: dict[str, Any], override: str) -> None:
    path, equals, text = override.partition("=")
    keys = path.strip().split(".")
    where = f"--set {override}"
    if not equals or len(keys) < 2:
        raise ConfigError(f"{where}: expected node.key=value or run.key=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    names = [n.get("name") for n in table.get("nodes", []) if isinstance(n, dict)]
    if keys[0] == "run":
        target = table.setdefault("run", {})
    elif keys[0] in names:
        target = table["nodes"][names.index(keys[0])]
    else:
        known = ["run", *(str(n) for n in names)]
        raise ConfigError(
            f"{where}: expected the name of a node or run, found {keys[0]!r}"
            + suggest(keys[0], known)
        )
    for key in keys[1:-1]:
        if isinstance(target, list):  # an entry of a list of tables, by its name
            target = next((t for t in target if t.get("name") == key), None)
        else:
            target = target.setdefault(key, {})
        if not isinstance(target, dict | list):
            raise ConfigError(f"{where}: expected a table at {key!r}, found {_show(target)}")
    if not isinstance(target, dict):
        raise ConfigError(f"{where}: expected a table before {keys[-1]!r}")
    target[keys[-1]] = value


def _decode(type_: type[Any], value: Any) -> Any:
    if type_ is Duration:
        return Duration.parse(value)
    raise NotImplementedError(f"settings of type {type_}")


_NAMES = {
    "`float`": "a number",
    "`int`": "a whole number",
    "`str`": "a text",
    "`bool`": "true or false",
    "`array`": "a list",
    "`object`": "a table",
    "`null`": "nothing",
    " | a whole number | ": " or ",
}


def _explain(message: str, value: Any, type_: type[msgspec.Struct], where: str) -> str:
    """Rewrite one of msgspec's messages as place, expected, found."""
    text, _, path = message.partition(" - at `$")
    path = path.rstrip("`")
    for theirs, ours in _NAMES.items():
        text = text.replace(theirs, ours)
    if match := re.fullmatch(r"Object contains unknown field `(.*)`", text):
        known = _fields_at(type_, path)
        listed = ", ".join(known) or "no settings"
        return f"{where}{path}: expected one of {listed}; found unknown key {match[1]!r}" + suggest(
            match[1], known
        )
    if match := re.fullmatch(r"Object missing required field `(.*)`", text):
        return f"{where}{path}: expected a setting {match[1]!r}, found none"
    expected = re.sub(r", got .*", "", text)
    expected = expected[0].lower() + expected[1:]
    if not expected.startswith("expected"):
        expected = f"expected another value ({expected})"
    return f"{where}{path}: {expected}, found {_show(_at(value, path))}"


def _at(value: Any, path: str) -> Any:
    """Return what stands at a path such as ``.cameras[0].rate``."""
    for name, index in re.findall(r"\.([\w-]+)|\[(\d+)\]", path):
        try:
            value = value[name] if name else value[int(index)]
        except (KeyError, IndexError, TypeError):
            return value
    return value


def _fields_at(type_: Any, path: str) -> list[str]:
    """Return the names of the settings that are known at a path."""
    for name in re.findall(r"\.([\w-]+)", path):
        field = next((f for f in msgspec.structs.fields(type_) if f.name == name), None)
        inner = getattr(field, "type", None)
        while inner is not None and not hasattr(inner, "__struct_fields__"):
            inner = next((a for a in getattr(inner, "__args__", ())), None)
        if inner is None:
            return []
        type_ = inner
    return list(type_.__struct_encode_fields__)


def _show(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


def _known_modules() -> list[str]:
    return [name for name in sys.modules if name.startswith(("sims.", "nodes."))]
