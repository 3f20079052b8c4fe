"""Which nodes of a file fly, and by what a flight is known: settings, sources, files, machine."""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib.util
import json
import os
import re
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import xxhash

from runtime.config.model import Config, NodeSpec, to_builtins
from runtime.paths import written
from runtime.run.environment import environment
from runtime.run.graph import edges

_DRIVERS = (
    *("/usr/lib/*/libEGL*", "/usr/lib/*/libgallium*", "/usr/lib/*/libLLVM*", "/usr/lib/*/dri/*"),
    "/proc/driver/nvidia/version",
)
_VARIABLES = re.compile("MUJOCO_|E?GL|_?_?E?GL[VX]?_|LIBGL_|GALLIUM_|MESA_|LP_")
_PARSING = threading.Lock()
"""Python 3.11's parser counts the depth of all threads in one place (cpython#106905)."""
_NAMED = re.compile(r'\bfile\w*\s*=\s*"([^"]+)"')
_FOLDERS = re.compile(r'(?:mesh|texture|asset)dir\s*=\s*"([^"]+)"')


def flight_of(config: Config) -> Config | None:
    """Return the part of a file that flies; `None` if something else has an influence on it.

    So does a node whose output a port of the flight takes, unless the port is narrowed to a source
    of the flight. Nodes that write files, or give no equal results, have to run themselves.
    """
    flying = {spec.name: spec for spec in config.nodes if spec.node.flies}
    if config.run.clock != "lockstep" or not flying:
        return None
    if any(
        not s.node.deterministic or s.node.files or [*written(s.config)] for s in flying.values()
    ):
        return None
    for sender, _, _, receiver, port in edges([(spec.name, spec.node) for spec in config.nodes]):
        if receiver in flying and sender not in flying:
            source = _narrowed(flying[receiver], port)
            if source is None or source.partition("/")[0] not in flying:
                return None
    return msgspec.structs.replace(config, nodes=tuple(flying.values()))


def _narrowed(spec: NodeSpec, port: str) -> str | None:
    bundle = port.partition(".")[0]
    declared = spec.node.declared
    ports: dict[str, Any] = {**declared.inputs, **declared.bundles, **declared.handlers}
    source: str | None = spec.inputs.get(port, spec.inputs.get(bundle, ports[bundle].source))
    return source


def settings_key(flight: Config) -> str:
    """Return what is equal for flights with equal settings."""
    run = flight.run
    nodes = to_builtins(flight)["nodes"]
    return _hashed([json.dumps([run.seed, run.duration, nodes], default=str, sort_keys=True)])


def content_key(flight: Config) -> str:
    """Return a key of what a flight depends on: settings, sources, files, libraries, drivers."""
    texts = [settings_key(flight), json.dumps(environment())]
    texts += [f"{k}={v}" for k, v in sorted(os.environ.items()) if _VARIABLES.match(k)]
    for pattern in _DRIVERS:
        for path in sorted(Path("/").glob(pattern[1:])):
            found = path.stat()
            texts.append(f"{path} {found.st_size} {found.st_mtime_ns}")
    here = (f"runtime.tools.flights.{name}" for name in ("layout", "recorder", "player"))
    files = {*_sources([*(spec.node.__module__ for spec in flight.nodes), *here])}
    for path in _paths(to_builtins(flight)["nodes"]):
        files |= _read_by(path)
    texts += [f"{path} {_hashed([path.read_bytes()])}" for path in sorted(files)]
    return _hashed(texts)


def _hashed(parts: Iterable[str | bytes]) -> str:
    digest = xxhash.xxh3_128()
    for part in parts:
        digest.update(part.encode() if isinstance(part, str) else part)
        digest.update(b"\0")
    return digest.hexdigest()


def _sources(modules: Iterable[str]) -> Iterator[Path]:
    """Yield the files of some modules and of what they import, but for what else is installed."""
    todo = [*modules, "events"]
    roots = {name.partition(".")[0] for name in todo}
    seen = {""}
    while todo:
        name = todo.pop()
        root = name.partition(".")[0]
        if name in seen or not (root in roots or _is_here(root)):
            continue
        seen.add(name)
        path = _origin(name)
        if path is None:
            continue
        package = path.name == "__init__.py"
        yield from (p for p in path.parent.iterdir() if p.is_file()) if package else [path]
        parent = name.rpartition(".")[0]
        todo.append(parent)
        todo += _imported(path, name if package else parent)


def _imported(path: Path, package: str) -> Iterator[str]:
    """Yield the modules that a file in a package imports anywhere, and what may be such.

    A file that is no Python names none.
    """
    if path.suffix not in {".py", ".pyi"}:
        return
    with contextlib.suppress(SyntaxError, ValueError):
        with _PARSING:
            todo: list[Any] = [ast.parse(path.read_bytes())]
        while todo:  # statements only, which takes a third of the time of `ast.walk`
            node = todo.pop()
            for field in ("body", "orelse", "finalbody", "handlers", "cases"):
                todo += getattr(node, field, ())
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                with contextlib.suppress(ImportError):  # beyond the topmost package
                    one = "." * node.level + (node.module or "")
                    whole = importlib.util.resolve_name(one, package)
                    yield from (whole, *(f"{whole}.{alias.name}" for alias in node.names))


def _origin(name: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(name)
    except Exception:  # a package is imported for what is in it, and may raise anything
        return None
    return Path(spec.origin) if spec and spec.has_location and spec.origin else None


@functools.cache
def _is_here(root: str) -> bool:
    """Return whether a module or package is neither Python's own nor installed."""
    path = None if not root or root in sys.stdlib_module_names else _origin(root)
    return path is not None and not {"site-packages", "dist-packages"} & {*path.parts}


def _paths(value: Any) -> Iterator[Path]:
    """Yield the files that settings name; reading the file has made their paths absolute."""
    if isinstance(value, str) and value.startswith("/") and Path(value).exists():
        yield Path(value)
    elif isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _paths(each)


def _read_by(path: Path) -> set[Path]:
    """Return a file and what a model of MuJoCo's includes, or what a folder holds."""
    if path.is_dir():
        return {each for each in path.rglob("*") if each.is_file()}
    found, todo, folders = {path}, [path], {path.parent}
    while todo:
        if (file := todo.pop()).suffix == ".xml":
            text = file.read_text(encoding="utf-8", errors="replace")
            folders |= {path.parent / name for name in _FOLDERS.findall(text)}
            named = {folder / name for folder in folders for name in _NAMED.findall(text)}
            todo += (new := sorted({each for each in named if each.is_file()} - found))
            found.update(new)
    return found
