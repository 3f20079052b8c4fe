"""Repetition of a bundled run: its settings and inputs, and whether the digests agree."""

from __future__ import annotations

import copy
import hashlib
import stat
import tomllib
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from runtime.commit import commit
from runtime.config.model import Config
from runtime.config.overrides import override
from runtime.config.reading import find_modules_in, parse
from runtime.errors import ResultsError
from runtime.run.summarise import environment
from runtime.summary import Summary
from runtime.tools.paper.bundle import FORMAT, MANIFEST, Manifest, inputs_of, sha256, size_of
from runtime.units import significant

_LARGEST = 1 << 28  # bytes of a file that is read as a whole
_UNPACKED = ("inputs/", "code/")
_CHUNK = 1 << 20


class Bundle(msgspec.Struct, frozen=True, eq=False):
    """A bundle, as read.

    Attributes:
        unpacked: Folder beside the archive with its inputs and code; `None` if it has none.
    """

    path: Path
    manifest: Manifest
    summary: Summary
    table: dict[str, Any]
    unpacked: Path | None


def read_bundle(path: Path) -> Bundle:
    """Read a bundle, and unpack its inputs and code into a folder of its name beside it.

    Files there that already are what they should be stay; others are replaced.

    Raises:
        ResultsError: It is none, or a file in it is damaged or would be unpacked elsewhere.
    """
    try:
        archive = zipfile.ZipFile(path)
    except OSError as error:
        raise ResultsError(f"{path}: expected a bundle, found: {error.strerror}") from None
    except zipfile.BadZipFile as error:
        raise ResultsError(f"{path}: expected a bundle, a ZIP archive, found: {error}") from None
    with archive:
        members = _members(archive, path)
        try:
            text = _content(archive, members, MANIFEST)
            manifest = msgspec.json.decode(text, type=Manifest)
            if manifest.format != FORMAT:
                raise ResultsError(
                    f"{path}: {MANIFEST}: expected format {FORMAT}, found {manifest.format}"
                )
            texts = {}
            for name in ("summary.json", "config.toml"):
                texts[name] = _content(archive, members, name)
                if sha256(texts[name]) != manifest.files.get(name):
                    raise ResultsError(
                        f"{path}: {name}: expected the hash in {MANIFEST}, found another"
                    )
            summary = msgspec.json.decode(texts["summary.json"], type=Summary)
            table = tomllib.loads(texts["config.toml"].decode())
        except KeyError as error:
            raise ResultsError(
                f"{path}: expected {error.args[0]} in a bundle, found none"
            ) from None
        except (ValueError, zipfile.BadZipFile) as error:
            raise ResultsError(f"{path}: expected a bundle, found: {error}") from None
        names = [name for name in members if name.startswith(_UNPACKED)]
        folder = path.absolute().with_suffix("") if names else None
        for name in names:
            assert folder is not None
            _unpack(archive, members[name], folder / name, manifest.files.get(name, ""), path)
    return Bundle(path, manifest, summary, table, folder)


def _members(archive: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
    """Return the members by name; raise `ResultsError` for one that leads elsewhere."""
    members: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        name = PurePosixPath(info.orig_filename)
        kind = stat.S_IFMT(info.external_attr >> 16)
        odd = kind not in {0, stat.S_IFREG} or info.is_dir() or info.orig_filename in members
        outside = name.is_absolute() or ".." in name.parts or "\\" in str(name) or "\0" in str(name)
        if odd or outside or str(name) != info.orig_filename:
            raise ResultsError(
                f"{path}: expected files with names inside a folder, found {info.orig_filename!r}"
            )
        members[info.orig_filename] = info
    return members


def _content(archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo], name: str) -> bytes:
    info = members[name]
    if info.file_size > _LARGEST:
        raise ValueError(f"{name} of {size_of(info.file_size)}")
    return archive.read(info)


def _unpack(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, expected: str, path: Path
) -> None:
    """Write a member; raise `ResultsError` unless it has the expected hash."""
    if target.is_file() and not target.is_symlink() and sha256(target) == expected:
        return
    folder = path.absolute().with_suffix("")
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.parent.resolve().is_relative_to(folder.resolve()) or target.is_symlink():
        raise ResultsError(f"{target}: expected a file in {folder}, found a link that leads out")
    digest = hashlib.sha256()
    with archive.open(info) as source, target.open("wb") as file:
        while chunk := source.read(_CHUNK):
            digest.update(chunk)
            file.write(chunk)
    if digest.hexdigest() != expected:
        target.unlink()
        raise ResultsError(
            f"{path}: {info.filename}: expected the hash in {MANIFEST}, found another"
        )


def configuration(bundle: Bundle, overrides: Sequence[str] = ()) -> tuple[Config, list[str]]:
    """Return the settings of a bundled run, and sentences on inputs that are not the same.

    Paths of inputs that are in the bundle lead to the unpacked ones. Modules of nodes are looked
    for in its code and in the working folder.

    Raises:
        ConfigError: The settings cannot be read here, as a node is missing.
        ResultsError: An input is missing.
    """
    moved = {
        file.path: str(bundle.unpacked / file.archived)
        for file in bundle.manifest.inputs
        if file.archived and bundle.unpacked is not None
    }
    table = _moved(bundle.table, moved)
    find_modules_in(Path.cwd())
    if bundle.unpacked is not None:
        find_modules_in(bundle.unpacked / "code")
    changed = copy.deepcopy(table)
    for change in overrides:
        override(changed, change)
    config = parse(changed, str(bundle.path))
    _as_written(config.run, table.get("run", {}))
    for spec, row in zip(config.nodes, table["nodes"], strict=True):
        _as_written(spec.config, row)
    notes = []
    places: dict[str, list[Path]] = {}
    for setting, files in inputs_of(config):
        places.setdefault(setting, []).extend(files)
    for file in bundle.manifest.inputs:
        paths = places.get(file.setting, [])
        path = paths.pop(0) if paths else Path(moved.get(file.path, file.path))
        expected = f"{size_of(file.size)}, sha256 {file.sha256[:16]}…"
        if not path.exists():
            raise ResultsError(
                f"{file.setting}: expected {path} ({expected}), found none: say where it is with "
                f"--set {file.setting}=PATH"
            )
        if (actual := sha256(path)) != file.sha256:
            notes.append(f"{file.setting}: {path} is not that of the bundle: expected {expected}, "
                         f"found sha256 {actual[:16]}…")  # fmt: skip
    return config, notes


def _moved(value: Any, moved: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _moved(inner, moved) for key, inner in value.items()}
    if isinstance(value, list):
        return [_moved(inner, moved) for inner in value]
    return moved.get(value, value) if isinstance(value, str) else value


def _as_written(value: Any, table: Any) -> Any:
    """Return a setting with the whole numbers that stand in the run's ``config.toml``.

    The default of a float may be an int, 200, and is one in the run and in its announcements, whose
    fingerprint tells 200 from 200.0; read back, it would be a float.
    """
    if isinstance(value, float) and type(table) is int and value == table:
        return table
    if isinstance(value, msgspec.Struct) and isinstance(table, dict):
        for field in msgspec.structs.fields(type(value)):
            if field.encode_name in table:  # so that it is this struct's own, and not a default
                new = _as_written(getattr(value, field.name), table[field.encode_name])
                msgspec.structs.force_setattr(value, field.name, new)
    elif isinstance(value, dict) and isinstance(table, dict):
        return {key: _as_written(inner, table.get(key)) for key, inner in value.items()}
    elif type(value) in {list, tuple} and isinstance(table, list) and len(value) == len(table):
        pairs = zip(value, table, strict=True)
        return type(value)(_as_written(inner, written) for inner, written in pairs)
    return value


class Agreement(msgspec.Struct, frozen=True):
    """Comparison of a repetition with the bundled run.

    Attributes:
        agrees: Whether all digests are equal.
        lines: Sentences: on inputs, on outputs by node, and what else differs if they do.
    """

    agrees: bool
    lines: tuple[str, ...]


def compare_runs(bundle: Bundle, summary: Summary) -> Agreement:
    """Compare a repetition with the bundled run, by the digests of inputs and outputs."""
    before = bundle.summary
    if before.digest is None or summary.digest is None:
        side = "the bundle" if before.digest is None else "this run"
        return Agreement(False, (f"not compared: {side} has no digest",))
    inputs = _differing(before.inputs, summary.inputs)
    outputs = _differing(before.digests, summary.digests)
    outside = [
        name
        for name in sorted(before.outside.keys() | summary.outside.keys())
        if (b := before.outside.get(name)) is None
        or (n := summary.outside.get(name)) is None
        or (b.inputs, b.answers) != (n.inputs, n.answers)
    ]
    lines = [
        f"inputs differ: {', '.join(inputs)}"
        if inputs
        else f"inputs agree: digest {summary.inputs_digest}"
    ]
    if not outputs:
        lines.append(f"outputs agree: digest {summary.digest}")
    by_node: dict[str, list[str]] = {}
    for output in outputs:
        by_node.setdefault(output.partition(".")[0], []).append(output)
    for node, names in by_node.items():
        kind = "the estimator" if node in before.code else "the node"
        lines.append(
            f"outputs differ of {kind} {node} ({', '.join(names)})"
            + _figures(node, before, summary)
        )
    lines += [f"what the system {name} was sent or answered differs" for name in outside]
    if differs := bool(inputs or outputs or outside):
        lines += _reasons(bundle, summary)
    return Agreement(not differs, tuple(lines))


def _differing(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    return sorted(k for k in before.keys() | now.keys() if before.get(k) != now.get(k))


def _figures(node: str, before: Summary, now: Summary) -> str:
    """Return the error of an estimator in both runs, if it was judged in both."""
    bundled, repeated = (run.verdict.estimators if run.verdict else {} for run in (before, now))
    texts = []
    for name in repeated:
        old, new = (figures.get(name, {}).get("ate_percent") for figures in (bundled, repeated))
        if name.partition("/")[0] == node and old is not None and new is not None:
            texts.append(
                f": ate_percent {significant(old, 4)} in the bundle, {significant(new, 4)} here"
            )
    return "".join(texts)


def _reasons(bundle: Bundle, summary: Summary) -> Iterator[str]:
    """Yield what else is not the same."""
    before = bundle.summary
    if before.clock != "lockstep" or before.not_deterministic:
        cause = ", ".join(before.not_deterministic) or "its real clock"
        yield f"the bundle does not promise that it repeats, because of {cause}"
    for node in sorted(before.code.keys() & summary.code.keys()):
        if before.code[node] != summary.code[node]:
            yield f"the code of {node} is not that of the bundle"
    then, now = before.environment | {"commit": bundle.manifest.commit}, environment()
    for name, value in (now | {"commit": commit()}).items():
        if name not in {"cores", "command"} and then.get(name, value) != value:
            yield f"{name} is {value or 'unknown'} here, {then[name] or 'unknown'} in the bundle"
