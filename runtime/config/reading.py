"""From a TOML file to typed settings; errors name the place, the expected and the found value.

[run]                                   # -> RunConfig
clock = "lockstep"

[network]                               # -> NetworkConfig, for a run in several processes

[[nodes]]                               # -> NodeSpec, one a node, in order
name = "drone"
type = "Multirotor"                     # an entry point's name, or module:Class
on_error = "stop"                       # optional, like `inputs`
inputs = { setpoints = "pilot" }        # narrow a port to a source
links = { setpoints = { delay = "80ms" } }  # make the way there worse than perfect
rate = 30                               # all other keys: the node's own settings

Presets are tables of settings by name, which a table of the file takes and overrides key by key:

    imu = "bmi088"                                      # all of a preset
    imu = { preset = "bmi088", g_sensitivity = 0.0 }    # all but one setting

A settings class offers them by a field ``preset``, whose type holds them::

    class ImuParameters(...):
        preset: Annotated[str | None, msgspec.Meta(extra={"presets": IMUS})] = None

Beside ``"presets"``, ``"needed": {"width": "intrinsics"}`` says that who overrides a preset's width
has to override its intrinsics, if it has any.

They are put in where a file is read. The settings hold all figures then, and no `preset`, so that a
run repeats from them where a later version changes it.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import math
import re
import sys
import tomllib
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, get_origin

import msgspec

from runtime.channels.links import LinkConfig
from runtime.channels.ports import MAX_HZ
from runtime.config.explain import explain, show, struct_in, types_of
from runtime.config.model import Config, NetworkConfig, NodeSpec, OnError, RunConfig
from runtime.config.overrides import override
from runtime.errors import ConfigError, DeclarationError, VisnavError, expect_known, suggest
from runtime.extras import CONFIGURATIONS, NODES, missing_extension, offers
from runtime.node import Node
from runtime.paths import not_utf8, resolve, unmarked
from runtime.units import Duration

S = TypeVar("S", bound=msgspec.Struct)


class _NodeHead(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    type: str
    on_error: OnError = "stop"
    inputs: dict[str, str] = {}
    links: dict[str, Any] = {}


def load_configuration(path: Path, overrides: Sequence[str] = ()) -> Config:
    """Read a configuration file: TOML, or a package's format, chosen by suffix.

    Raises:
        ConfigError: Something in the file is wrong.
        CommandError: The package's reader cannot be imported.
    """
    for offer in offers(CONFIGURATIONS):
        if path.suffix.lower() == f".{offer.name}":
            return load(path, overrides, partial(offer.load(), warn=_warn_once))
    if whose := missing_extension(path.suffix.lower()):
        raise ConfigError(f"{path}: {path.suffix} is read by {whose}")
    return load(path, overrides)


@cache
def _warn_once(warning: str) -> None:
    print(f"warning: {warning}", file=sys.stderr)


def load(
    path: Path,
    overrides: Sequence[str] = (),
    read: Callable[[str, str], dict[str, Any]] | None = None,
) -> Config:
    """Read a file, with changes as of `--set`.

    Relative paths start, and modules of nodes are looked for, in its folder.

    Args:
        read: Makes the table of a whole file from its text and its name, if it is not TOML.

    Raises:
        ConfigError: Something in it is wrong.
    """
    table = (read or _read_toml)(text_of(path), str(path))
    folder = path.resolve().parent
    if why := not_utf8(folder):
        raise ConfigError(f"{path.name}: {why}")
    find_modules_in(folder)
    for change in overrides:
        override(table, change)
    return parse(table, path.name, folder)


def text_of(path: Path) -> str:
    """Return the text of a file, or raise `ConfigError`."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: expected a readable file, found: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: expected UTF-8 text, found {error.reason}") from None


def _read_toml(text: str, path: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: expected TOML, found: {error}") from None
    except ValueError as error:  # of Python's int()
        raise ConfigError(f"{path}: expected numbers of a usual size, found: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path}: expected TOML, found brackets nested too deep") from None


def find_modules_in(folder: Path) -> None:
    """Have modules of nodes looked for in a folder, too, after all other places."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def parse(table: Mapping[str, Any], where: str, folder: Path | None = None) -> Config:
    """Convert a table given by `tomllib` into settings.

    Args:
        where: Begins the message of an error.
        folder: Where relative paths start; the working directory if not given.

    Raises:
        ConfigError: Something in the table is wrong.
    """
    folder = folder or Path.cwd()
    _refuse_extremes(table, where)
    for key in table:
        message = f"{where}: expected tables [run], [network] and [[nodes]], found {key!r}"
        expect_known(key, ["run", "network", "nodes"], message)
    run = convert(unmarked(table.get("run", {})), RunConfig, f"{where}: run")
    if not run.name.strip() or "/" in run.name or "\0" in run.name or run.name.startswith("."):
        raise ConfigError(
            f"{where}: run.name: expected a name for a folder, without / and not beginning with "
            f"a dot, found {show(run.name)}"
        )
    if run.clock == "real" and run.speed in {"max", math.inf}:
        raise ConfigError(
            f'{where}: run.speed: expected a number with clock "real", found {show(run.speed)}'
        )
    nodes = table.get("nodes", [])
    if not isinstance(nodes, list) or not nodes:
        raise ConfigError(f"{where}: nodes: expected at least one [[nodes]] table, found none")
    specs: list[NodeSpec] = []
    for index, entry in enumerate(nodes):
        spec = _node(entry, f"{where}: nodes[{index}]", folder)
        if spec.name in {other.name for other in specs}:
            raise ConfigError(
                f"{where}: nodes[{index}].name: expected a name that no other node has, "
                f"found {show(spec.name)} a second time"
            )
        specs.append(spec)
    network = convert(
        resolve(table.get("network", {}), NetworkConfig, folder), NetworkConfig, f"{where}: network"
    )
    if not re.fullmatch(r"\w+/.+", network.meet):
        raise ConfigError(
            f"{where}: network.meet: expected a Zenoh endpoint such as tcp/192.168.0.7:7450, "
            f"found {show(network.meet)}"
        )
    return Config(run=run, nodes=tuple(specs), network=network)


def _refuse_extremes(table: Mapping[str, Any], where: str) -> None:
    """Refuse values beyond TOML's guarantees: integers over 64 bits, too deep nesting."""
    left: list[tuple[Any, int]] = [(table, 0)]
    while left:
        value, depth = left.pop()
        if isinstance(value, Mapping):
            left += [(inner, depth + 1) for inner in value.values()]
        elif isinstance(value, list):
            left += [(inner, depth + 1) for inner in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ConfigError(f"{where}: expected whole numbers of 64 bits, found a larger one")
        if depth > _DEEPEST:
            raise ConfigError(
                f"{where}: expected tables and lists at most {_DEEPEST} deep, found deeper ones"
            )


_DEEPEST = 32


def find_nodes(warn: Callable[[str], None]) -> dict[str, type[Node[Any]]]:
    """Return the node classes offered by packages, by name, sorted; warn of broken ones."""
    nodes = {}
    offered = Counter(offer.name for offer in offers(NODES))
    for package, name, value in offers(NODES):
        try:
            nodes[name if offered[name] == 1 else value] = find_node(value, value)
        except VisnavError as error:
            warn(f"a node of the package {package}: {error}")
    return dict(sorted(nodes.items()))


def find_node(type_: str, where: str) -> type[Node[Any]]:
    """Import a node's class by the name of an entry point, or by ``module:Class``.

    Raises:
        ConfigError: There is no such name, module or class, it is not a node, or several packages
            offer a node of this name.
    """
    if re.fullmatch(r"\w+", type_):
        offered = {offer.value: offer.package for offer in offers(NODES) if offer.name == type_}
        if not offered and (whose := missing_extension(type_)):
            raise ConfigError(f"{where}: {type_} is a node of {whose}")
        if not offered:
            names = [offer.name for offer in offers(NODES)]
            raise ConfigError(
                f'{where}: expected the name of a node or "module:Class", found {show(type_)}'
                + suggest(type_, names)
            )
        if len(offered) > 1:
            whose = ", ".join(f"{value} of {package}" for value, package in offered.items())
            raise ConfigError(f"{where}: expected one node named {type_}, found {whose}")
        type_ = next(iter(offered))
    module_name, _, class_name = type_.partition(":")
    if not re.fullmatch(r"\w+(\.\w+)*:\w+", type_):
        raise ConfigError(
            f'{where}: expected the name of a node or "module:Class", found {show(type_)}'
        )
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not module_name.startswith(error.name):
            raise ConfigError(f"{where}: {module_name} needs a module {error.name!r}") from error
        raise ConfigError(
            f"{where}: expected a module that can be imported, found {show(module_name)}"
            + suggest(module_name, _known_modules())
        ) from None
    except ImportError as error:
        raise ConfigError(f"{where}: {module_name} cannot be imported: {error}") from error
    except DeclarationError as error:
        frames = traceback.extract_tb(error.__traceback__)
        here = str(Path(__file__).parents[1])
        outside = [
            frame
            for frame in frames
            if not frame.filename.startswith((here, "<frozen"))
            and frame.name != "__init_subclass__"
        ]
        place = f"{outside[-1].filename}, line {outside[-1].lineno}"
        raise ConfigError(f"{where}: {module_name}: {error} ({place})") from error
    except VisnavError:
        raise
    except Exception as error:  # whatever a module of the user's does
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = "" if isinstance(error, SyntaxError) else f" ({last.filename}, line {last.lineno})"
        raise ConfigError(
            f"{where}: {module_name} cannot be imported: {type(error).__name__}: {error}{place}"
        ) from error
    node = vars(module).get(class_name)
    if isinstance(node, type) and issubclass(node, Node) and (lacks := abstract(node)):
        raise ConfigError(f"{where}: {type_}: expected {lacks} in it, found none")
    known = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Node) and not is_base(value)
    }
    message = f"{where}: expected a node of {module_name}, found {show(class_name)}"
    expect_known(class_name, known, message)
    return known[class_name]


def abstract(cls: type[Node[Any]]) -> str:
    """Return the abstract methods of a class, as code."""
    names = sorted(getattr(cls, "__abstractmethods__", ()))
    waits = {name for name in names if inspect.iscoroutinefunction(getattr(cls, name))}
    return ", ".join(f"`{'async ' * (name in waits)}def {name}`" for name in names)


def is_base(cls: type[Node[Any]]) -> bool:
    """Return whether a class is there to be subclassed, and no node for a file."""
    return cls is Node or inspect.isabstract(cls)


def convert(value: Any, type_: type[S], where: str) -> S:
    """Convert a table to a struct, with its presets applied.

    Raises:
        ConfigError: A key or a preset is unknown, a key is missing, or a value is of the wrong type
            or size, or not finite. (A run's `speed` may be infinite, and so may thresholds.)
    """
    value = expanded(value, type_, where)
    for path, number in _not_finite(value):
        if math.isnan(number) or not (type_ is RunConfig or ".thresholds." in path):
            text = f"expected a finite number, found {number} - at `${path}`"
            raise ConfigError(explain(text, value, type_, where))
    try:
        return msgspec.convert(value, type_, dec_hook=_decode)
    except msgspec.ValidationError as error:
        raise ConfigError(explain(str(error), value, type_, where)) from None


Presets = Mapping[str, Mapping[str, Any]]


def presets_in(extra: Mapping[str, Any] | None) -> Presets:
    """Return the presets in the `extra` of a type's `Meta`."""
    presets: Presets = (extra or {}).get("presets", {})
    return presets


def by_name_alone(table: type[msgspec.Struct]) -> list[str]:
    """Return the presets whose name may stand in the place of the whole table."""
    required = any(field.required for field in msgspec.structs.fields(table))
    return [] if required else [*presets_in(_extra(table))]


def expanded(value: Any, type_: Any, where: str, at: str = "") -> Any:
    """Return settings of the file with their presets applied, at any depth.

    Raises:
        ConfigError: There is no such preset, or a setting is overridden without one it belongs to.
    """
    table = None if get_origin(type_) is dict else struct_in(type_)
    if table is None:
        return value
    if isinstance(value, list):
        return [expanded(entry, table, where, f"{at}[{i}]") for i, entry in enumerate(value)]
    extra = _extra(table)
    if isinstance(value, str) and extra:
        value = {"preset": value}
    if not isinstance(value, Mapping):
        return value
    if isinstance(value.get("preset"), str) and extra:
        value = _apply_preset(value, extra, f"{where}: {f'{at}.preset'[1:]}")
    types = types_of(table)
    return {k: expanded(v, types.get(k), where, f"{at}.{k}") for k, v in value.items()}


def _apply_preset(value: Mapping[str, Any], extra: Mapping[str, Any], where: str) -> dict[str, Any]:
    presets, name = presets_in(extra), value["preset"]
    listed = ", ".join(presets)
    expect_known(name, presets, f"{where}: expected one of {listed}, found {show(name)}")
    preset = presets[name]
    for key, other in extra.get("needed", {}).items():
        changed = key in value and value[key] != preset.get(key)
        if changed and other in preset and other not in value:
            raise ConfigError(
                f"{where}: expected {other} beside {key}, since that of {name} belongs to its own "
                f"{key}, found none"
            )
    return _merged(preset, {key: inner for key, inner in value.items() if key != "preset"})


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    both = {**below, **above}
    for key in below.keys() & above.keys():
        old, new = below[key], above[key]
        if isinstance(old, Mapping) and isinstance(new, Mapping) and "preset" not in new:
            both[key] = _merged(old, new)
    return both


@cache
def _extra(table: type[msgspec.Struct]) -> Mapping[str, Any]:
    """Return what the type of a settings class's field ``preset`` holds; nothing without one."""
    marks = getattr(types_of(table).get("preset"), "__metadata__", ())
    return next((mark.extra for mark in marks if presets_in(mark.extra)), {})


def _not_finite(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(value, float) and not math.isfinite(value):
        yield path, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _not_finite(inner, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _not_finite(inner, f"{path}[{index}]")


def _node(entry: Any, where: str, folder: Path) -> NodeSpec:
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: expected a table, found {show(entry)}")
    keys = {f.name for f in msgspec.structs.fields(_NodeHead)}
    head = convert(unmarked({k: v for k, v in entry.items() if k in keys}), _NodeHead, where)
    if not re.fullmatch(r"[A-Za-z_][\w-]*", head.name):
        raise ConfigError(
            f"{where}.name: expected a letter, then letters, digits, _ and -, "
            f"found {show(head.name)}"
        )
    if head.name in {"run", "network"}:
        raise ConfigError(
            f"{where}.name: expected any name but those of the file's other tables, found "
            f"{show(head.name)}"
        )
    where = f"{where} ({head.name})"
    cls = find_node(head.type, f"{where}: type")
    rest = {k: v for k, v in entry.items() if k not in keys}
    config = convert(resolve(rest, cls.config_type, folder), cls.config_type, where)
    ports = [*cls.declared.listening, *cls.declared.bundle_fields()]
    for key, port in [("inputs", p) for p in head.inputs] + [("links", p) for p in head.links]:
        expected = f"{where}: {key}: expected an input or handler of {head.type}"
        expect_known(port, ports, f"{expected}, found {show(port)}")
    for method, ticks in cls.declared.ticks.items():
        if isinstance(ticks.hz, str):
            rate = getattr(config, ticks.hz, None)
            if not isinstance(rate, int | float) or not 0 < rate <= MAX_HZ:
                raise ConfigError(
                    f"{where}: {ticks.hz}: expected a rate above 0, up to {MAX_HZ} Hz, "
                    f"for {method}, found {show(rate)}"
                )
    return NodeSpec(
        name=head.name,
        type_name=head.type,
        on_error=head.on_error,
        inputs=head.inputs,
        links={
            port: convert(link, LinkConfig, f"{where}: links.{port}")
            for port, link in head.links.items()
        },
        node=cls,
        config=config,
    )


def _decode(type_: type[Any], value: Any) -> Any:
    if issubclass(type_, Duration):
        return type_.parse(value)
    raise NotImplementedError(f"settings of type {type_}")


def _known_modules() -> list[str]:
    names = []
    for room in ("sims", "nodes"):
        spec = importlib.util.find_spec(room)
        for folder in (spec and spec.submodule_search_locations) or ():
            for file in Path(folder).rglob("*.py"):
                inside = file.relative_to(folder).with_suffix("").parts
                names.append(".".join((room, *inside)).removesuffix(".__init__"))
    return names
