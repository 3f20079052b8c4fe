"""What a run is made from: code, programs, files and libraries, each part with a hash.

A run, a recorded flight and an estimator are known by the same parts. A finished run is valid as
long as each part has the hash that it was made with; so is a flight, whose parts are those of the
nodes that fly. Parts have names for readers, relative to the folder that they are found in, so that
machines on which folders differ agree:

    my_estimator.py      a module, a script or a program, with the files that it needs itself
    mav0                 a folder named by a setting, without results of runs in it
    numpy                an installed distribution: version and hash
    python, machine      versions

A folder that is only named, in code, in a file of settings or on a command line, counts as such a
file does, unless everything lies in it or it has more than `MOST_FILES` files.

What is not seen: files that neither a text nor their folder's name tells of, those that a compiled
program opens by names of its own, libraries that it loads while it runs, what is in a container.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from runtime.config.model import Config, NodeSpec
from runtime.extras import READERS, SENSORS, WORLDS, others
from runtime.node import CommandLine
from runtime.paths import inputs, written
from runtime.run.results import MARKER
from runtime.run.sources import (
    LARGE,
    MOST_FILES,
    OURS,
    TOOL,
    Finder,
    Found,
    code_modules,
    content_hash,
    distributions,
    find_sources,
    hashed,
    text_of,
)
from runtime.units import plain

Parts = dict[str, str]
"""Hash by the name of a part."""


class Roots(msgspec.Struct, frozen=True):
    """Where the parts of a run begin; the same for equal settings.

    Attributes:
        modules: Of the nodes' classes, and of whoever carries out the run.
        folder: In which modules of nodes and relative paths are looked for, beside the usual
            places.
        inputs: Files and folders that are inputs by the type of their settings.
        texts: Other texts of settings, which may name files, folders or modules.
        programs: Programs that nodes start.
    """

    modules: tuple[str, ...] = ()
    folder: str = ""
    inputs: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    programs: tuple[CommandLine, ...] = ()


RUN = ("runtime.run.execute", "events")
"""Modules that carry out every run."""


def roots_of(config: Config, folder: Path | None = None, modules: Iterable[str] = RUN) -> Roots:
    """Return where the parts of a run begin.

    Args:
        folder: Of the file with the settings.
        modules: Of whoever carries out the run.
    """
    files: dict[str, None] = {}
    texts: dict[str, None] = {}
    programs: list[CommandLine] = []
    for spec in config.nodes:
        besides = [*spec.node.made_from(spec.config)]
        lines = [source for source in besides if isinstance(source, CommandLine)]
        of_programs = {text for line in lines for text in line.texts()}
        input_files = [file for file in inputs(spec.config) if file not in of_programs]
        files |= dict.fromkeys(input_files)
        files |= dict.fromkeys(str(source) for source in besides if isinstance(source, Path))
        apart = {*written(spec.config), *of_programs, *input_files}
        settings = msgspec.to_builtins(spec.config, enc_hook=plain)
        texts |= dict.fromkeys(text for text in _texts(settings) if text not in apart)
        programs += lines
    named = (spec.type_name.partition(":") for spec in config.nodes)
    used_modules = {spec.node.__module__ for spec in config.nodes}
    used_modules |= {module for module, colon, _ in named if colon}
    # Sensors, readers and worlds of other packages, as nothing here tells which of them are used.
    plugged = (offer for group in (SENSORS, READERS, WORLDS) for offer in others(group))
    used_modules |= {offer.value.partition(":")[0] for offer in plugged}
    return Roots(
        modules=tuple(sorted({*modules, *used_modules})),
        folder=str(folder or ""),
        inputs=tuple(files),
        texts=tuple(texts),
        programs=tuple(programs),
    )


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        if len(value) < 4096 and value.isprintable():
            yield value
    elif isinstance(value, dict | list | tuple):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def made_from(roots: Roots) -> Parts:
    """Return the parts of a run as they are now.

    Never raises: a file that is missing or cannot be read is a part of its own kind.
    """
    collector = _Collector(roots.folder)
    finder = Finder([Path(roots.folder)] if roots.folder else [])
    collector.read_settings(roots.inputs, finder)
    possible = collector.read_settings(roots.texts, finder, certain=False)
    collector.add_code(finder, roots.modules, possible=possible)
    for line in roots.programs:
        collector.add_program(line)
    return collector.parts() | {"python": platform.python_version(), "machine": platform.machine()}


def code_of(spec: NodeSpec, folder: Path | None = None) -> str:
    """Return the hash of a node's own files: its class with local imports, and its programs.

    The events and the runtime, which the commit tells, are no part of it.
    """
    collector = _Collector(str(folder or ""))
    finder, module = Finder([folder] if folder else []), spec.node.__module__
    if module == "__main__":  # a script, or a notebook
        script = Path(getattr(sys.modules[module], "__file__", None) or "")
        collector.add_code(finder, scripts=[script] if script.is_file() else [], libraries=False)
        with contextlib.suppress(OSError, TypeError):
            collector.add_text(spec.node.__qualname__, inspect.getsource(spec.node))
    else:
        collector.add_code(finder, [module], ours=_of_nodes, libraries=False)
    for source in spec.node.made_from(spec.config):
        if isinstance(source, CommandLine):
            collector.add_program(source, libraries=False)
    return key_of(collector.parts())


def program_of(line: CommandLine) -> Path | None:
    """Return the file of a program; `None` if there is none."""
    environment = {**os.environ, "VISNAV_PYTHON": sys.executable, **dict(line.environment)}
    word = _expanded(line.words[0], environment) if line.words else ""
    place = shutil.which(Path(line.folder, word) if "/" in word else word)
    return None if place is None else Path(place).absolute()


def files_of(spec: NodeSpec) -> dict[str, Path]:
    """Return the files of a node's class and its local imports by name, but none of this project.

    Names are relative to the folder in which the module is looked for.
    """
    sources = find_sources(Finder([]), [spec.node.__module__], ours=_of_nodes)
    return {
        name: Path(min(paths))
        for name, paths in sorted(sources.files.items())
        if name.partition("/")[0] not in OURS and name not in sources.named
    }


def _of_nodes(module: str) -> bool:
    return module.partition(".")[0] not in {"events", "runtime"}


def key_of(parts: Parts) -> str:
    """Return a key, equal for equal parts."""
    return hashed(f"{name} {parts[name]}" for name in sorted(parts))


def changes(before: Parts, now: Parts) -> list[str]:
    """Return what differs between parts, in words: ``my_estimator.py changed``.

    A new file that is only named somewhere is no difference: without it the run went well, and may
    have written it.
    """
    changed = sorted(name for name in before.keys() & now.keys() if before[name] != now[name])
    new = sorted(now.keys() - before.keys())
    ours = [name for name in changed if name.partition("/")[0] in OURS]
    if len(ours) > _MOST_OF_OURS:
        changed = ["visnav-runtime", *(name for name in changed if name not in ours)]
    return [
        *(f"{name} changed" for name in changed),
        *(f"{name} is new" for name in new if not now[name].startswith(_NAMED)),
        *(f"{name} is gone" for name in sorted(before.keys() - now.keys())),
    ]


def during(before: Parts, after: Parts) -> tuple[Parts, list[str]]:
    """Return what a run was made from, and what of it changed while the run was under way.

    A file that is only named somewhere, and neither code nor settings, was written by the run if it
    changed meanwhile: that is no part of it.
    """
    made = {
        name
        for name in before
        if before[name].startswith(_WRITABLE) and before[name] != after.get(name)
    }
    parts = {name: part for name, part in before.items() if name not in made}
    return parts, changes(parts, {k: v for k, v in after.items() if k not in made})


_NAMED, _WRITABLE = "~", "~~"
"""Begin the hashes of files that are only named somewhere: of all, and of those that are data."""

_MOST_OF_OURS = 3  # files of this project that are named one by one


_SETTINGS = frozenset({
    ".bash", ".cfg", ".conf", ".ini", ".jinja", ".json", ".launch", ".sh", ".toml", ".xml", ".yaml",
    ".yml",
})  # fmt: skip
_SOURCES = frozenset({
    ".c", ".cc", ".cmake", ".cpp", ".cu", ".cuh", ".cxx", ".f90", ".go", ".h", ".hh", ".hpp",
    ".hxx", ".inl", ".ipp", ".jl", ".py", ".pyx", ".rs", ".toml", ".zig",
})  # fmt: skip
_BUILD_FILES = frozenset({"CMakeLists.txt", "Makefile", "makefile", "Cargo.lock", "package.xml"})
_BUILT = frozenset({"build", "install", "log", "target", "devel", "CMakeFiles", "node_modules"})
_RESULTS = frozenset({"runs", "sweeps", "compared", "judged", "__pycache__"})
_SYSTEM = (
    "/bin/", "/dev/", "/etc/", "/lib/", "/lib32/", "/lib64/", "/proc/", "/sbin/", "/sys/", "/usr/",
)  # fmt: skip
_TOKEN = re.compile(r"""[^\s"'`=;:,|&()<>{}\[\]$#]+""")
_FILES = re.compile(r"""\bfile\w*\s*=\s*["']([^"']+)["']""")
_FOLDERS = re.compile(r"""(?:mesh|texture|asset)dir\s*=\s*["']([^"']+)["']""")


class _Collector:
    """Parts of a run while they are gathered."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder or Path.cwd())
        self._files: dict[str, set[str]] = {}  # paths by name
        self._folders: dict[str, dict[Path, bool]] = {}  # by name; whether they are inputs
        self._others: Parts = {}
        self._named: dict[str, str] = {}  # how hashes of files that are only named begin

    def parts(self) -> Parts:
        """Return the hashes of all that was added."""
        files = {
            name: self._named.get(name, "")
            + hashed(content_hash(Path(path)) for path in sorted(paths))
            for name, paths in self._files.items()
        }
        return files | self._hashes_of_folders() | self._others

    def add_text(self, name: str, text: str) -> None:
        """Add a text that is in no file."""
        self._others[name] = hashed([text])

    def read_settings(
        self, texts: Iterable[str], finder: Finder, *, certain: bool = True
    ) -> list[str]:
        """Add the files and folders named by settings; return the names of possible modules.

        Args:
            certain: Whether they are inputs.
        """
        modules = []
        for text in texts:
            module, colon, _ = text.partition(":")
            if colon and module.replace(".", "_").isidentifier():
                modules.append(module)
            elif text.replace(".", "_").isidentifier() and finder.is_beside(text):
                modules.append(text)
            if text.startswith("/"):
                if _is_file(Path(text)) or _is_data(Path(text)):
                    self._add(Path(text), [], certain=certain)
            elif "/" in text or "." in text:
                for base in (self._folder, Path.cwd()):
                    if _is_file(base / text):
                        self._add(base / text, [], certain=certain)
                        break
            if not text.startswith("/"):
                for base in dict.fromkeys((self._folder, Path.cwd())):
                    self._add_named_folder(base / text, Path(text).as_posix())
        return modules

    def add_code(
        self,
        finder: Finder,
        modules: Iterable[str] = (),
        scripts: Iterable[Path] = (),
        *,
        possible: Iterable[str] = (),
        ours: Callable[[str], bool] = lambda _: True,
        libraries: bool = True,
        working: Path | None = None,
    ) -> None:
        """Add the files of modules and scripts with what they import."""
        sources: Found = find_sources(
            finder, modules, scripts, possible=possible, ours=ours, working=[working or Path.cwd()]
        )
        for name, paths in sources.folders.items():
            for path in paths:
                self._add_named_folder(Path(path), name, [working or Path.cwd()])
        for name, paths in sources.files.items():
            for path in paths:
                self._add_path(name, path, certain=name not in sources.named)
                if path.endswith(".so") and name.partition("/")[0] not in OURS and libraries:
                    self._add_libraries(Path(path), None)
        if libraries:
            self._others |= distributions(sources.installed, finder.sites)

    def add_program(self, line: CommandLine, *, libraries: bool = True) -> None:
        """Add a program and the files on its command line."""
        environment = {**os.environ, "VISNAV_PYTHON": sys.executable, **dict(line.environment)}
        working = Path(line.folder).absolute()
        words = [_expanded(word, environment) for word in line.words]
        scripts: list[Path] = []
        first = [Path(entry) for entry in environment.get("PYTHONPATH", "").split(":") if entry]
        for text in (value for _, value in line.environment):
            if _is_file(working / text):
                scripts += self._add(working / text, [working], line, certain=False)
        for text in _arguments(words[1:]):
            path = Path(os.path.normpath(working / text))
            inside = "/" in text and path not in {working, *working.parents}
            if _is_file(path) or (inside and _is_data(path)):
                scripts += self._add(path, [working], line, certain=False)
            else:
                self._add_named_folder(path, path.name, [working])
        for word in line.build:
            if _is_file(path := working / _expanded(word, environment)):
                self._add(path, [working], line)
        if line.build:
            self._add_sources(working)
        program = _executable(words, working, environment)
        modules: list[str] = []
        sites: Sequence[Path] | None = None
        if program is not None and re.fullmatch(r"(python|pypy)[\d.]*", program.name):
            script, modules = _python_arguments(words[1:], working)
            first = [script.parent if script else working, *first]
            sites = _sites(program)
            if Path(os.path.realpath(program)) != Path(os.path.realpath(sys.executable)):
                self._add_path(program.name, str(program))
        elif program is not None:
            scripts += self._add(program, [working], line, libraries=libraries)
            if program in scripts:
                first = [program.parent, *first]
                sites = _sites(program)
        if scripts or modules:
            first += [script.parent for script in scripts]
            self.add_code(
                Finder(first, sites), modules, scripts, libraries=libraries, working=working
            )

    def _add_path(self, name: str, path: str, *, certain: bool = True) -> None:
        if not certain and name not in self._files:
            self._named[name] = _NAMED if _kind(Path(path)) else _WRITABLE
        elif certain:
            self._named.pop(name, None)
        self._files.setdefault(name, set()).add(os.path.normpath(Path(path).absolute()))

    def _add(
        self,
        path: Path,
        bases: Sequence[Path],
        line: CommandLine | None = None,
        *,
        certain: bool = True,
        libraries: bool = True,
    ) -> list[Path]:
        """Add a file with the files that it names, or a folder; return the Python scripts.

        Args:
            bases: Folders in which files are looked for, and from which they are named.
            line: Of the program that is given the file.
            certain: Whether it is an input, and not perhaps an output.
        """
        scripts, todo, seen = [], [path], set()
        while todo:
            path = todo.pop()
            if path in seen or path.suffix == ".pyc":
                continue
            seen.add(path)
            if not _is_file(path):
                if _is_data(path):
                    self._add_folder(path, certain=certain)
                continue
            kind = _kind(path)
            if kind == "program" and line is not None and line.build and _within(path, bases):
                continue  # it is made from sources, which count
            self._add_path(self._name(path, bases), str(path), certain=certain)
            if kind == "python":
                scripts.append(path)
            elif kind == "program" and libraries:
                self._add_libraries(path, line)
            elif path.suffix == ".xml":
                todo += included(path)
            elif kind == "text":
                for named in _named_in(path, [path.parent, *bases]):
                    if named.is_dir():
                        self._add_named_folder(
                            named, self._name(named, bases), [path.parent, *bases]
                        )
                    else:
                        todo.append(named)
        if line is None and scripts:
            self.add_code(Finder([script.parent for script in scripts]), scripts=scripts)
        return scripts

    def _name(self, path: Path, bases: Sequence[Path]) -> str:
        for base in [*bases, self._folder]:
            with contextlib.suppress(ValueError):
                return path.absolute().relative_to(base).as_posix()
        return path.name

    def _add_folder(self, folder: Path, *, certain: bool) -> None:
        of_name = self._folders.setdefault(folder.name, {})
        folder = Path(os.path.normpath(folder.absolute()))
        of_name[folder] = certain or of_name.get(folder, False)

    def _add_named_folder(self, folder: Path, name: str, around: Iterable[Path] = ()) -> None:
        """Add a folder that is only named in a text, and is none around others."""
        folder = Path(os.path.normpath(folder.absolute()))
        if _is_named_data(folder, [self._folder, *around]):
            self._folders.setdefault(name, {}).setdefault(folder, False)

    def _hashes_of_folders(self) -> Parts:
        result = {}
        for name, folders in self._folders.items():
            hashes: list[str] = []
            for folder in sorted(folders):
                files = sorted(_files_in(folder))
                large = sum(size for _, size in files) > LARGE
                lines = [f"{path} {content_hash(folder / path, large=large)}" for path, _ in files]
                hashes.append(hashed(lines))
            result[name] = ("" if any(folders.values()) else _WRITABLE) + hashed(hashes)
        return result

    def _add_sources(self, folder: Path) -> None:
        for name, _ in _files_in(folder, without=_RESULTS | _BUILT):
            path = folder / name
            if path.suffix in _SOURCES or path.name in _BUILD_FILES:
                self._add_path(name, str(path))

    def _add_libraries(self, program: Path, line: CommandLine | None) -> None:
        environment = dict(line.environment) if line is not None else {}
        system = []
        for path in _libraries(program, environment.get("LD_LIBRARY_PATH")):
            if path.startswith(_SYSTEM):
                system.append(f"{Path(path).name} {content_hash(Path(path))}")
            else:
                self._add_path(Path(path).name, path)
        if system:
            name = f"system libraries of {program.name}"
            self._others[name] = hashed(sorted(system))


def _expanded(word: str, environment: Mapping[str, str]) -> str:
    return re.sub(r"\$(?:(\w+)|{(\w+)})", lambda m: environment.get(m[1] or m[2], m[0]), word)


def _arguments(words: Iterable[str]) -> list[str]:
    """Return all that may be a path, such as ``x.yaml`` of ``--settings=x.yaml``."""
    texts: dict[str, None] = {}
    for word in words:
        pieces = [word]
        if re.search(r"\s", word):
            with contextlib.suppress(ValueError):
                pieces += shlex.split(word)
        for piece in pieces:
            texts |= dict.fromkeys([piece, *re.split(":=|=|:", piece)[1:]])
    return [text for text in texts if text.strip("-.") and "\0" not in text]


def _executable(words: Sequence[str], working: Path, environment: Mapping[str, str]) -> Path | None:
    if not words or "$" in words[0]:
        return None
    place = str(working / words[0]) if "/" in words[0] else words[0]
    program = shutil.which(place, path=environment.get("PATH"))
    if program is None and _is_file(Path(place)):
        program = place
    return None if program is None else Path(program)


def _python_arguments(words: Sequence[str], working: Path) -> tuple[Path | None, list[str]]:
    """Return the script and the modules that an interpreter is given."""
    rest = iter(words)
    for word in rest:
        if word == "-m":
            return None, [next(rest, "")]
        if word == "-c":
            return None, [*code_modules(next(rest, ""))]
        if word in {"-X", "-W"}:
            next(rest, None)
        elif not word.startswith("-"):
            return working / word, []
    return None, []


def _sites(program: Path) -> Sequence[Path] | None:
    """Return the folders of packages of the interpreter of a program; `None` for our own."""
    prefix = program.absolute().parent.parent
    if prefix in {Path(sys.prefix), Path(sys.base_prefix)}:
        return None
    return sorted(
        folder
        for name in ("site-packages", "dist-packages")
        for folder in prefix.glob(f"l*/python*/{name}")
    )


def _kind(path: Path) -> str:
    with contextlib.suppress(OSError):
        with path.open("rb") as file:
            head = file.read(128)
        if head.startswith(b"\x7fELF"):
            return "program"
        if path.suffix == ".py" or (head.startswith(b"#!") and b"python" in head):
            return "python"
        if head.startswith(b"#!") or path.suffix in _SETTINGS:
            return "text"
    return ""


def _is_file(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):  # too long a name, a zero in it
        return path.is_file()
    return False


def _is_data(path: Path) -> bool:
    """Return whether a path is a folder of data, and none that everything lies in."""
    path, home = Path(os.path.normpath(path)), Path(os.environ.get("HOME") or "/")
    around = {Path("/"), home, *home.parents}
    return path.is_dir() and path not in around and not f"{path}/".startswith(_SYSTEM)


def _is_folder(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return path.is_dir()
    return False


def _is_named_data(folder: Path, around: Iterable[Path]) -> bool:
    """Return whether a folder that a text names is one of data, of at most `MOST_FILES` files.

    It is none if it is around what is worked on, directly below ``/``, a package, or has results of
    runs.
    """
    if not _is_folder(folder) or not _is_data(folder) or folder.name in _RESULTS:
        return False
    around = (*around, Path.cwd(), TOOL, Path(tempfile.gettempdir()))
    inside = (Path(os.path.normpath(place.absolute())) for place in around)
    if len(folder.parts) <= 2 or any(place.is_relative_to(folder) for place in inside):
        return False
    with contextlib.suppress(OSError):
        if any((folder / name).exists() for name in ("__init__.py", MARKER, "rows.jsonl")):
            return False
        return not folder.name.startswith(".") and _is_small(folder)
    return False


def _is_small(folder: Path) -> bool:
    """Return whether a folder has at most `MOST_FILES` files and folders."""
    count, todo, seen = 0, [str(folder)], set()
    while todo:
        inside = os.path.realpath(todo.pop())
        if inside in seen:
            continue
        seen.add(inside)
        with contextlib.suppress(OSError), os.scandir(inside) as entries:
            for entry in entries:
                count += 1
                if count > MOST_FILES:
                    return False
                if entry.is_dir():
                    todo.append(entry.path)
    return True


def _within(path: Path, folders: Iterable[Path]) -> bool:
    return any(path.absolute().is_relative_to(folder) for folder in folders)


_LINKED: dict[tuple[str, str | None, int, int], list[str]] = {}


def _libraries(program: Path, search: str | None) -> list[str]:
    """Return the shared libraries that a program is linked with."""
    status = program.stat()
    key = str(program), search, status.st_mtime_ns, status.st_size
    if key not in _LINKED:
        environment = {**os.environ, **({"LD_LIBRARY_PATH": search} if search else {})}
        output = ""
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            output = subprocess.run(  # noqa: S603  # a program that the run starts anyway
                ["ldd", str(program.absolute())], env=environment,  # noqa: S607
                capture_output=True, text=True, check=False, timeout=20.0,
            ).stdout  # fmt: skip
        _LINKED[key] = re.findall(r"(?:=>|^)\s*(/\S+) \(0x", output, re.MULTILINE)
    return _LINKED[key]


def included(path: Path) -> list[Path]:
    """Return the files that a MuJoCo model and the models that it includes name."""
    included, todo, folders = {path}, [path], {path.parent}
    while todo:
        if (file := todo.pop()).suffix == ".xml":
            text = file.read_text(encoding="utf-8", errors="replace")
            folders |= {base / name for name in _FOLDERS.findall(text) for base in [*folders]}
            named = {folder / name for folder in folders for name in _FILES.findall(text)}
            todo += (new := sorted({file for file in named if file.is_file()} - included))
            included.update(new)
            folders |= {added.parent for added in new if added.suffix == ".xml"}
    return sorted(included - {path})


def _named_in(path: Path, bases: Iterable[Path]) -> Iterator[Path]:
    """Yield the files and folders that a script or a file of settings names."""
    for token in dict.fromkeys(_TOKEN.findall(text_of(path))):
        for base in bases:
            named = base / token
            may_be_file = "." in token or "/" in token
            if (may_be_file and _is_file(named)) or _is_folder(named):
                if not str(named).startswith(_SYSTEM):
                    yield named
                break


def _files_in(folder: Path, without: frozenset[str] = _RESULTS) -> Iterator[tuple[str, int]]:
    """Yield relative path and size of a folder's files, without hidden ones and results of runs."""
    seen: set[tuple[int, int]] = set()
    todo = [""]
    while todo:
        inside = todo.pop()
        with contextlib.suppress(OSError):
            entries = list(os.scandir(folder / inside))
            names = {entry.name for entry in entries}
            mark = (folder / inside).stat()
            if (mark.st_dev, mark.st_ino) in seen:
                continue
            seen.add((mark.st_dev, mark.st_ino))
            if inside and (MARKER in names or "rows.jsonl" in names):
                continue
            for entry in entries:
                path = f"{inside}/{entry.name}".lstrip("/")
                if entry.name.startswith(".") or entry.name in without:
                    continue
                if entry.is_dir():
                    todo.append(path)
                elif entry.is_file() and not entry.name.endswith(".pyc"):
                    yield path, entry.stat().st_size
