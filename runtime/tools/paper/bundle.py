"""Bundle of a run: one archive with what it was made from and what came out.

An archive (ZIP) has these files, each with its hash in ``bundle.json``:

    bundle.json     `Manifest`: seed, digests, versions, commits, inputs and programs with hashes
    README.txt      the same for a reader, with the command that repeats the run
    config.toml     all settings
    summary.json, figures.csv, report.html, plots/, evaluation/, trajectories/
    inputs/, code/  files that the settings name, and code of nodes, with ``--with-inputs`` alone

Equal folders give equal archives: names are sorted, times are those of no day. `runtime.tools.paper
.repeat` runs it again.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from runtime.commit import commit, of_repository
from runtime.config.model import Config, NodeSpec
from runtime.config.reading import find_modules_in, load_configuration
from runtime.errors import ConfigError, ResultsError
from runtime.node import CommandLine
from runtime.paths import inputs
from runtime.run.made_from import (
    Parts,
    code_of,
    files_of,
    included,
    made_from,
    program_of,
    roots_of,
)
from runtime.run.results import MARKER, replacing, time_of
from runtime.summary import Summary
from runtime.tools.paper.typeset import combinations_of, figures_table, typeset
from runtime.tools.summaries import read_summary
from runtime.units import plain

FORMAT = 1
MANIFEST = "bundle.json"
_RESULTS = ("config.toml", "summary.json", "report.html", "plots", "evaluation", "trajectories")
_APART = ("command", "commit")
_MADE = (MARKER, "README.txt", MANIFEST)


class InputFile(msgspec.Struct, frozen=True, kw_only=True):
    """A file or folder that a setting of a node names.

    Attributes:
        setting: As for ``--set``: ``replay.recording``; the node alone if no setting names it.
        path: On the machine of the run.
        size: Bytes, of a folder of all its files.
        sha256: Of a folder of its files' names and hashes; empty if it was not there any more.
        archived: Its name in the archive; empty if it is not in it.
    """

    setting: str
    path: str
    size: int = 0
    sha256: str = ""
    archived: str = ""


class Program(msgspec.Struct, frozen=True, kw_only=True):
    """A program that a node starts; never in the archive.

    Attributes:
        command: With its arguments, as the settings have them.
        sha256: Of its file; empty if it was not found.
        commit: Of the repository that its file, or its folder, belongs to.
    """

    node: str
    command: tuple[str, ...]
    path: str = ""
    sha256: str = ""
    commit: str = ""


class Estimator(msgspec.Struct, frozen=True, kw_only=True):
    """An estimator's code.

    Attributes:
        type: Of its node, as in the settings.
        code: Hash of its own files when the run began, as in ``summary.json``.
        commit: Of the repository that its class belongs to; empty if that is not known.
    """

    type: str
    code: str
    commit: str = ""


class ExcludedFile(msgspec.Struct, frozen=True):
    """A file of the run's folder that is not in the archive."""

    path: str
    size: int
    sha256: str


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of ``bundle.json``.

    Attributes:
        repeat: The command that runs it again, and compares.
        command: The command that ran it.
        commit: Of the tool.
        made_from: Hash of each part of the run when the bundle was made: code, libraries, files.
        code: Hash of each file of nodes' code in the archive, without ``code/``.
        files: Hash (SHA-256) of each file in the archive, but of this one.
        left_out: Files of the run's folder that are not in it.
        notes: Sentences on what may keep it from repeating, and on what is not in it.
    """

    format: int
    name: str
    seed: int
    digest: str | None
    inputs_digest: str | None
    repeat: str
    command: str
    commit: str
    environment: dict[str, str]
    estimators: dict[str, Estimator]
    inputs: tuple[InputFile, ...]
    programs: tuple[Program, ...]
    made_from: Parts
    files: dict[str, str]
    left_out: tuple[ExcludedFile, ...]
    notes: tuple[str, ...]


Entries = dict[str, bytes | Path]
"""Contents of an archive by name."""


def write_bundle(folder: Path, out: Path, *, with_inputs: bool = False) -> Manifest:
    """Write the bundle of a finished run; return its manifest.

    Modules of nodes are looked for in the working folder, too.

    Raises:
        ResultsError: The folder is no run's, or has no summary or settings.
        ConfigError: The settings cannot be read here, as the module of a node is missing.
    """
    if not (folder / "config.toml").is_file():
        raise ResultsError(f"{folder}: expected the config.toml of a run, found none")
    summary = read_summary(folder, Summary)
    find_modules_in(Path.cwd())
    try:
        config = load_configuration(folder / "config.toml")
    except ConfigError as error:
        raise ConfigError(
            f"{error}; modules beside the file of a run are found in the folder of that file"
        ) from None
    entries: Entries = {
        path.relative_to(folder).as_posix(): path
        for name in _RESULTS
        for path in _files(folder / name)
    }
    files = [*_inputs(config, entries, with_inputs=with_inputs)]
    if with_inputs:
        for spec in config.nodes:
            entries |= {f"code/{name}": path for name, path in files_of(spec).items()}
    if summary.verdict is not None and summary.verdict.estimators:
        entries["figures.csv"] = _figures(summary)
    programs = tuple(_programs(config))
    left_out = tuple(
        ExcludedFile(path.relative_to(folder).as_posix(), path.stat().st_size, sha256(path))
        for path in _files(folder)
        if path.relative_to(folder).as_posix() not in {*entries, *_MADE}
    )
    estimators = {
        spec.name: Estimator(
            type=spec.type_name, code=summary.code[spec.name],
            commit=of_repository(Path(sys.modules[spec.node.__module__].__file__ or "")),
        )
        for spec in config.nodes
        if spec.name in summary.code
    }  # fmt: skip
    manifest = Manifest(
        format=FORMAT, name=summary.name, seed=summary.seed, digest=summary.digest,
        inputs_digest=summary.inputs_digest,
        repeat=f"python -m runtime run --from {out.name}",
        command=summary.environment.get("command", ""),
        commit=summary.environment.get("commit", ""),
        environment={k: v for k, v in summary.environment.items() if k not in _APART},
        estimators=estimators, inputs=tuple(files), programs=programs,
        made_from=made_from(roots_of(config, Path.cwd())),
        files={}, left_out=left_out,
        notes=tuple(_notes(folder, config, summary, files, programs, left_out, entries)),
    )  # fmt: skip
    entries["README.txt"] = _readme(manifest).encode()
    hashes = {name: sha256(entries[name]) for name in sorted(entries)}
    manifest = msgspec.structs.replace(manifest, files=hashes)
    entries[MANIFEST] = msgspec.json.format(msgspec.json.encode(manifest), indent=2) + b"\n"
    _write_archive(out, entries)
    return manifest


def sha256(content: bytes | Path) -> str:
    """Return the SHA-256 of bytes or of a file; of a folder that of its files' names and hashes."""
    if isinstance(content, bytes):
        return hashlib.sha256(content).hexdigest()
    if content.is_dir():
        lines = (
            f"{path.relative_to(content).as_posix()} {sha256(path)}\n" for path in _files(content)
        )
        return hashlib.sha256("".join(lines).encode(errors="surrogateescape")).hexdigest()
    with content.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _files(path: Path) -> list[Path]:
    """Return a file, or all files of a folder, sorted."""
    if path.is_file():
        return [path]
    return sorted(file for file in path.rglob("*") if file.is_file())


def _inputs(config: Config, entries: Entries, *, with_inputs: bool) -> Iterator[InputFile]:
    """Yield the inputs of all nodes, and add those to be archived to the entries."""
    seen: set[Path] = set()
    for number, (setting, paths) in enumerate(inputs_of(config)):
        base = Path(os.path.commonpath([path.parent for path in paths]))
        for path in paths:
            if path in seen:
                continue
            seen.add(path)
            name = ""
            if with_inputs and path.exists():
                relative = path.relative_to(base).as_posix()
                name = f"inputs/{number}-{base.name}/{relative}"
                for file in _files(path):
                    inside = file.relative_to(path).as_posix() if path.is_dir() else ""
                    entries[f"{name}/{inside}".removesuffix("/")] = file
            size = sum(file.stat().st_size for file in _files(path))
            yield InputFile(
                setting=setting, path=str(path), size=size, archived=name,
                sha256=sha256(path) if path.exists() else "",
            )  # fmt: skip


def inputs_of(config: Config) -> Iterator[tuple[str, list[Path]]]:
    """Yield setting and files of each input of the nodes, in their order.

    The first is what the setting names, the others are what that names itself: a model's meshes.
    """
    for spec in config.nodes:
        lines = [line for line in sources_of(spec) if isinstance(line, CommandLine)]
        programs = {text for line in lines for text in line.texts()}
        table = msgspec.to_builtins(spec.config, enc_hook=plain)
        for text in inputs(spec.config):
            if text.startswith("/") and text not in programs:
                path = Path(text)
                included_files = included(path) if path.is_file() else []
                yield f"{spec.name}{_place(table, text) or ''}", [path, *included_files]
        for source in sources_of(spec):
            if isinstance(source, Path):
                yield spec.name, [source.absolute()]


def sources_of(spec: NodeSpec) -> list[Path | CommandLine]:
    """Return the files and programs that a node is made from beside its settings."""
    return [*spec.node.made_from(spec.config)]


def _place(value: Any, text: str) -> str | None:
    """Return where a text stands in a table: ``.cameras.front.mask``."""
    if value == text:
        return ""
    pairs: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Mapping):
        pairs = value.items()
    elif isinstance(value, list | tuple):
        pairs = ((part.get("name", k) if isinstance(part, Mapping) else k, part)
                 for k, part in enumerate(value))  # fmt: skip
    for key, inner in pairs:
        if (below := _place(inner, text)) is not None:
            return f".{key}{below}"
    return None


def _programs(config: Config) -> Iterator[Program]:
    for spec in config.nodes:
        for line in sources_of(spec):
            if not isinstance(line, CommandLine) or not line.words:
                continue
            path, folder = program_of(line), Path(line.folder or ".")
            yield Program(
                node=spec.name, command=line.words, path=str(path or ""),
                sha256="" if path is None else sha256(path),
                commit=(of_repository(path) if path else "") or _of_folder(folder),
            )  # fmt: skip


def _of_folder(folder: Path) -> str:
    """Return the commit of a program's folder, by the first of its files that git knows."""
    commits = (of_repository(path) for path in sorted(folder.glob("*.*"))[:20] if path.is_file())
    return next(filter(None, commits), "")


def _figures(summary: Summary) -> bytes:
    verdict = summary.verdict
    assert verdict is not None
    numbers = {
        name: None
        for figures in verdict.estimators.values()
        for name, value in figures.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    rows = combinations_of(verdict, numbers)
    return typeset(figures_table(rows, (), [*numbers]), "csv").encode()


def _notes(
    folder: Path,
    config: Config,
    summary: Summary,
    files: Sequence[InputFile],
    programs: Sequence[Program],
    left_out: Sequence[ExcludedFile],
    entries: Entries,
) -> Iterator[str]:
    if summary.digest is None:
        yield "the run has no digest: a repetition cannot be compared"
    if summary.clock != "lockstep":
        yield "the clock is real: a repetition is not promised to give the same"
    elif summary.not_deterministic:
        names = ", ".join(summary.not_deterministic)
        yield f"a repetition is not promised to give the same, because of {names}"
    if (then := summary.environment.get("commit", "")) != (now := commit()):
        yield f"the tool is of commit {now or 'unknown'} now, the run was of {then or 'unknown'}"
    if then.endswith("-dirty"):
        yield f"files of the tool differed from commit {then.removesuffix('-dirty')} in the run"
    for spec in config.nodes:
        if summary.code.get(spec.name, code := code_of(spec)) != code:
            yield f"the code of {spec.name} is not what it was in the run"
    when = time_of(folder)
    for file in files:
        if not file.sha256:
            yield f"{file.setting}: {file.path} is not there any more"
        elif max((f.stat().st_mtime for f in _files(Path(file.path))), default=0.0) > when:
            yield f"{file.setting}: {file.path} was changed after the run"
    if outside := [file for file in files if file.sha256 and not file.archived]:
        yield f"inputs are not in it, only their hashes: {_listed(outside)}"
    for program in programs:
        record = "only its hash" if program.sha256 else "it was not found"
        yield f"the program of {program.node} is not in it, {record}: {program.command[0]}"
    if left_out:
        yield f"files of the run are not in it, only their hashes: {_listed(left_out)}"
    if not any(name.startswith("plots/") for name in entries):
        yield f"it has no plots: `python -m runtime report {folder}` draws them, before a bundle"


def _listed(files: Sequence[InputFile | ExcludedFile]) -> str:
    names = [f"{Path(file.path).name} ({size_of(file.size)})" for file in files]
    return ", ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)


def size_of(size: float) -> str:
    """Return a number of bytes as a text: ``1.2 GB``."""
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _readme(manifest: Manifest) -> str:
    """Return the text for a reader."""
    lines = [
        f"Run {manifest.name}, seed {manifest.seed}", "",
        "Repeat it, and compare:", "", f"    {manifest.repeat}", "",
        f"It was run by: {manifest.command}",
        f"Commit of visnav-runtime: {manifest.commit or 'unknown'}",
        f"Digest: {manifest.digest or 'off'}",
        f"Digest of the inputs: {manifest.inputs_digest or 'off'}",
        "", "Estimators:",
    ]  # fmt: skip
    lines += [
        f"  {name} ({e.type}): code {e.code}, commit {e.commit or 'unknown'}"
        for name, e in manifest.estimators.items()
    ]
    lines += ["", "Programs:"] * bool(manifest.programs)
    lines += [
        f"  {p.node}: {' '.join(p.command)}: sha256 {p.sha256 or 'unknown'}, commit "
        f"{p.commit or 'unknown'}"
        for p in manifest.programs
    ]
    lines += ["", "Inputs:"] * bool(manifest.inputs)
    lines += [
        f"  {i.setting}: {i.archived or i.path}, {size_of(i.size)}, sha256 {i.sha256 or 'unknown'}"
        for i in manifest.inputs
    ]
    lines += ["", "Where it was run:"]
    lines += [f"  {name}: {value}" for name, value in manifest.environment.items()]
    lines += ["", "Notes:"] * bool(manifest.notes)
    lines += [f"  - {note}" for note in manifest.notes]
    return "\n".join(lines) + "\n"


_EPOCH = (1980, 1, 1, 0, 0, 0)  # the first time that a ZIP archive knows


def _write_archive(out: Path, entries: Entries) -> None:
    with replacing(out) as new, zipfile.ZipFile(new, "w") as archive:
        for name in sorted(entries):
            info = zipfile.ZipInfo(name, _EPOCH)
            info.create_system, info.external_attr = 3, 0o644 << 16
            info.compress_type = zipfile.ZIP_DEFLATED
            content = entries[name]
            if isinstance(content, bytes):
                archive.writestr(info, content, compresslevel=9)
                continue
            with content.open("rb") as file, archive.open(info, "w", force_zip64=True) as inside:
                shutil.copyfileobj(file, inside, 1 << 20)
