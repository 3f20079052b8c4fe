"""Files of Python code: modules with all that they import, and installed distributions.

A module counts with its imports anywhere in its code, with modules that it loads by a name written
there (``importlib.import_module("x")``, ``"module:Class"``), and, outside this project, with files
and folders beside it that its texts name. Where a name is computed, all modules of the package or
folder count. Code that is installed counts by its distribution: version and hashes of ``RECORD``;
the standard library by Python's version.

Nothing is imported to find this out. Files are read once a process, until their size or time of
change differs.
"""

from __future__ import annotations

import ast
import contextlib
import importlib.machinery
import itertools
import os
import re
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import msgspec
import xxhash

from runtime.commit import RECORD

T = TypeVar("T")


class _Text(ast.Constant):
    value: str


TOOL = Path(__file__).resolve().parents[2]
"""Folder of this project's packages."""

OURS = frozenset({"bench", "events", "nodes", "runtime", "sims"})

LARGE = 64_000_000
"""Bytes beyond which a file counts by name, size and time of change instead of its content."""

MOST_FILES = 10_000
"""Files and folders in a folder beyond which it does not count where it is only named."""

_MOST_MATCHES = 1000  # files beyond which those of a pattern do not count
_SETTLED = 2.0  # seconds after which a change of a file also changes its time
_INSTALLED = {"site-packages", "dist-packages"}
_ENDS = tuple(importlib.machinery.all_suffixes())
_PARSING = threading.Lock()
"""Lock for Python 3.11's parser: all threads share a depth counter (cpython#106905)."""


def hashed(parts: Iterable[str | bytes]) -> str:
    """Return a hash of texts, in their order."""
    digest = xxhash.xxh3_128()
    for part in parts:
        digest.update(part.encode(errors="surrogateescape") if isinstance(part, str) else part)
        digest.update(b"\0")
    return digest.hexdigest()


def content_hash(path: Path, *, large: bool = False) -> str:
    """Return the hash of a file's content; of a `large` one that of name, size and time."""
    with contextlib.suppress(OSError):
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            return "no file"
        if large or status.st_size > LARGE:
            return hashed([path.name, str(status.st_size), str(status.st_mtime_ns)])
        return _once(path, _hash)
    return "missing"


def _hash(content: bytes) -> str:
    return xxhash.xxh3_128_hexdigest(content)


_KNOWN: dict[tuple[str, Any], tuple[tuple[int, ...], Any]] = {}


def _once(path: Path | str, make: Callable[[bytes], T]) -> T:
    """Return what is made of a file's content, as long as the file does not change."""
    key = os.fspath(path), make
    status = os.stat(path)  # noqa: PTH116  # making a path costs as much again
    mark = status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    known = _KNOWN.get(key)
    if known is not None and known[0] == mark:
        result: T = known[1]
        return result
    result = make(Path(path).read_bytes())
    if time.time() - status.st_mtime > _SETTLED:
        _KNOWN[key] = mark, result
    return result


def text_of(path: Path, most: int = 1_000_000) -> str:
    """Return the text of a small file; empty if it is large, binary, or cannot be read."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        if path.is_file() and path.stat().st_size <= most:
            return _once(path, bytes.decode)
    return ""


_Import = tuple[int, str, tuple[str, ...]]


class Code(msgspec.Struct, frozen=True):
    """What a Python file refers to.

    Attributes:
        imports: Level, module and names of its import statements.
        loaded: Modules loaded by a name in the text; ``.*`` at the end stands for all of a package.
        dynamic: Whether it loads modules by names that are computed.
        texts: Texts that may name files, modules or folders.
        places: Paths, or patterns with ``*``, that may be of files or folders, each with how many
            folders up from the file's they may begin.
        of_stem: Whether it makes the name of a file from its own.
    """

    imports: tuple[_Import, ...] = ()
    loaded: tuple[str, ...] = ()
    dynamic: bool = False
    texts: tuple[str, ...] = ()
    places: tuple[tuple[str, tuple[int, ...]], ...] = ()
    of_stem: bool = False


_LOADERS = {"import_module", "__import__", "run_module", "find_spec"}
_DISCOVERIES = {"iter_modules", "walk_packages", "spec_from_file_location", "run_path"}
_WRITERS = {
    "write_text", "write_bytes", "savetxt", "save", "savez", "savez_compressed", "imwrite",
    "to_csv", "savefig", "tofile", "touch", "mkdir", "makedirs", "rmtree",
}  # fmt: skip
_OF_STEM = ("with_suffix", "splitext", "stem", "removesuffix", "replace", "[:-3]")
_PATTERN = re.compile(r"(?!.*\*\*)(?=.*\w)[\w./ +~*-]{1,200}")
_FILE = re.compile(r"[\w./ +~-]{1,200}")
_REFERENCE = re.compile(r"([A-Za-z_]\w*(?:\.\w+)*):[A-Za-z_]\w*(?:\.\w+)*")
_DOTTED = re.compile(r"\.*[A-Za-z_]\w*(?:\.\w+)*")


def read_code(path: Path, *, whole: bool = True) -> Code:
    """Read what a file refers to; with `whole` also outside of its import statements."""
    if path.suffix not in {".py", ".pyi", ""}:
        return Code()
    with contextlib.suppress(OSError):
        return _once(path, _read_whole if whole else _read_imports)
    return Code()


def code_modules(text: str) -> Iterator[str]:
    """Yield the modules that code given as a text imports."""
    for _, module, names in _read_whole(text.encode()).imports:
        yield from (module, *(f"{module}.{name}" for name in names))


def _read_imports(content: bytes) -> Code:
    if any(name.encode() in content for name in ("import_module(", "__import__(")):
        return msgspec.structs.replace(
            _read_whole(content), dynamic=False, texts=(), places=(), of_stem=False
        )
    imports: list[_Import] = []
    todo: list[Any] = [_parsed(content)]
    while todo:  # statements only, which takes a third of the time of `ast.walk`
        node = todo.pop()
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            todo += getattr(node, field, ())
        imports += _import(node)
    return Code(tuple(imports))


def _read_whole(content: bytes) -> Code:
    imports: list[_Import] = []
    loaded, texts, dynamic = [], [], False
    written: set[str] = set()
    joined: list[list[str]] = []
    tree = _parsed(content)
    paths = _Paths(tree)
    places: list[tuple[list[_Text], str, tuple[int, ...]]] = []
    placed: set[int] = set()
    for node in ast.walk(tree):
        imports += _import(node)
        if _is_text(node):
            texts.append(node.value)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            joined.append([part.value for part in _joined(node)])
        elif isinstance(node, ast.Call):
            name = _called(node)
            if name in _LOADERS and (arguments := [*node.args, *(k.value for k in node.keywords)]):
                text, complete = _beginning(arguments[0])
                if complete:
                    loaded.append(text)
                elif "." in text:
                    loaded.append(text.rpartition(".")[0] + ".*")
                else:
                    dynamic = True
            dynamic |= name in _DISCOVERIES
            if name in _WRITERS or (name == "open" and _writes(node)):
                written |= {text.value for text in paths.texts_in(node)}
        inner, place, base = _place(node)
        if place and placed.isdisjoint(map(id, inner)):  # an outer expression is read first
            placed.update(map(id, inner))
            places.append((inner, place, paths.ups(base)))
    texts += ["/".join(parts) for parts in joined if not written.issuperset(parts)]
    literals = dict.fromkeys(
        text
        for text in texts
        if text not in written and (_FILE.fullmatch(text) or _REFERENCE.fullmatch(text))
    )
    unwritten_places = dict.fromkeys(
        (place, ups)
        for inner, place, ups in places
        if _PATTERN.fullmatch(place) and not written.issuperset(part.value for part in inner)
    )
    text = content.decode(errors="replace")
    of_stem = "__file__" in text and any(mark in text for mark in _OF_STEM)
    return Code(
        tuple(imports),
        tuple(dict.fromkeys(loaded)),
        dynamic,
        tuple(literals),
        tuple(unwritten_places),
        of_stem,
    )


class _Paths:
    """Expressions of paths in a file, with the names that are assigned once."""

    def __init__(self, tree: ast.AST) -> None:
        values: dict[str, list[ast.expr]] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for target in targets:
                    values.setdefault(_name(target), []).append(node.value)
        self._values = {name: v[0] for name, v in values.items() if name and len(v) == 1}

    def texts_in(self, node: ast.AST) -> Iterator[_Text]:
        """Yield the texts in an expression and in the values of the names in it."""
        todo, seen = [node], {""}
        while todo:
            for child in ast.walk(todo.pop()):
                if _is_text(child):
                    yield child
                elif (name := _name(child)) not in seen and name in self._values:
                    seen.add(name)
                    todo.append(self._values[name])

    def ups(self, base: ast.expr | None) -> tuple[int, ...]:
        """Return how many folders up from a file's folder an expression in it may be."""
        count, seen = 0, {""}
        while base is not None:
            name = _name(base)
            if name == "__file__":
                return (max(0, count - 1),)
            if name == "parent" and isinstance(base, ast.Attribute):
                count, base = count + 1, base.value
            elif isinstance(base, ast.Subscript) and _name(base.value) == "parents":
                number = base.slice.value if isinstance(base.slice, ast.Constant) else 0
                count += 1 + (number if isinstance(number, int) and 0 <= number < _UPS else 0)
                base = base.value.value if isinstance(base.value, ast.Attribute) else None
            elif isinstance(base, ast.Call):
                count += _called(base) == "dirname"
                method = isinstance(base.func, ast.Attribute) and _called(base) not in _WITH_PATH
                base = base.func.value if method else next(iter(base.args), None)  # type: ignore[attr-defined]
            elif isinstance(base, ast.BinOp):
                base = base.left
            else:
                base = None if name in seen else self._values.get(name)
                seen.add(name)
        return tuple(range(min(count, _UPS) + 1))


_UPS = 4
_WITH_PATH = {"Path", "PurePath", "abspath", "realpath", "dirname", "fspath", "join", "normpath"}


def _name(node: ast.AST) -> str:
    name = getattr(node, "id", getattr(node, "attr", ""))
    return name if isinstance(name, str) else ""


def _called(call: ast.Call) -> str:
    return _name(call.func)


def _place(node: ast.AST) -> tuple[list[_Text], str, ast.expr | None]:
    """Return the texts of a path, the path, and the expression that it begins with, if any."""
    base: ast.expr | None = None
    inner: list[_Text] = []
    if _is_text(node):
        return [node], node.value, None
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        inner, base = _joined(node), node.left
    elif isinstance(node, ast.Call) and _called(node) in {"join", "joinpath"}:
        arguments = list(node.args)
        if _called(node) == "joinpath" and isinstance(node.func, ast.Attribute):
            base = node.func.value
        elif len(arguments) > 1 and not _is_text(arguments[0]):
            base = arguments.pop(0)
        if len(node.args) > 1 or base is not None:
            others = (n for n, arg in enumerate(arguments) if not _is_text(arg))
            inner = [arg for arg in arguments[: next(others, len(arguments))] if _is_text(arg)]
    elif isinstance(node, ast.JoinedStr):
        inner = [part for part in node.values if _is_text(part)]
        first = node.values[0] if node.values else None
        place = "".join(part.value if _is_text(part) else "*" for part in node.values)
        if isinstance(first, ast.FormattedValue) and place.startswith("*/"):
            return inner, place[2:], first.value
        return inner, place, None
    return inner, "/".join(part.value for part in inner), base


def _is_text(node: ast.AST) -> TypeGuard[_Text]:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _writes(call: ast.Call) -> bool:
    """Return whether a call of ``open`` has a mode to write."""
    arguments = [*call.args, *(keyword.value for keyword in call.keywords)]
    return any(_is_text(arg) and re.fullmatch("[wax][bt+]*", arg.value) for arg in arguments)


def _parsed(content: bytes) -> ast.AST:
    with contextlib.suppress(SyntaxError, ValueError), _PARSING:
        return ast.parse(content)
    return ast.Module(body=[], type_ignores=[])


def _import(node: ast.AST) -> Iterator[_Import]:
    if isinstance(node, ast.Import):
        yield from ((0, alias.name, ()) for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        yield node.level, node.module or "", tuple(alias.name for alias in node.names)


def _joined(node: ast.expr) -> list[_Text]:
    """Return the texts at the end of ``folder / "a" / "b.npz"``."""
    if _is_text(node):
        return [node]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        last = _joined(node.right)
        return [*_joined(node.left), *last] if last else []
    return []


def _beginning(node: ast.expr) -> tuple[str, bool]:
    """Return the text that an expression begins with, and whether that is all of it."""
    if _is_text(node):
        return node.value, True
    if isinstance(node, ast.JoinedStr) and node.values:
        return _beginning(node.values[0])[0], False
    if isinstance(node, ast.BinOp):
        return _beginning(node.left)[0], False
    return "", False


class Finder:
    """Where the modules of a process are: first folders, then those of its interpreter.

    Args:
        first: Folders before all others, such as that of a script.
        sites: Folders of installed packages of another interpreter; `None` for this process's.
    """

    def __init__(self, first: Iterable[Path] = (), sites: Sequence[Path] | None = None) -> None:
        self.first = list(dict.fromkeys(map(str, first)))
        self.sites = sites
        self._roots: dict[str, tuple[str, list[str]]] = {}
        self._lists: dict[str, frozenset[str]] = {}

    def add(self, folder: str) -> None:
        """Search another folder, too."""
        if folder not in self.first:
            self.first.append(folder)
            self._roots.clear()

    def find(self, name: str) -> tuple[str, list[str]]:
        """Return a module's file (empty if it has none), and a package's folders."""
        root, *inner = name.split(".")
        if root not in self._roots:
            self._roots[root] = self._root(root)
        file, folders = self._roots[root]
        for part in inner:
            file, folders = self._inside(folders, part) if folders else ("", [])
        return file, folders

    def is_beside(self, name: str) -> bool:
        """Return whether a module is in one of the first folders."""
        return bool(self._inside(self.first, name.partition(".")[0])[0])

    def modules(self, folders: Iterable[str]) -> list[str]:
        """Return the names of the modules in a package's folders."""
        names = {
            entry.removesuffix(end)
            for folder in folders
            for entry in self._listed(folder)
            for end in _ENDS
            if entry.endswith(end)
        }
        return sorted(name for name in names if name.isidentifier() and name != "__init__")

    def _root(self, root: str) -> tuple[str, list[str]]:
        if root and (location := self._inside(self.first, root))[0]:
            return location
        if not root.isidentifier() or root in sys.stdlib_module_names:
            return "", []
        if self.sites is not None:
            return self._inside([*map(str, self.sites), *_linked(self.sites)], root)
        for (
            finder
        ) in sys.meta_path:  # `find_spec` of `importlib` knows what is loaded, perhaps gone
            spec = None
            with contextlib.suppress(Exception):  # whatever a package's own finder does
                spec = finder.find_spec(root, None)
            if spec is not None:
                file = spec.origin if spec.has_location and spec.origin else ""
                return file, list(spec.submodule_search_locations or ())
        return self._inside(self.first, root)

    def _inside(self, folders: Sequence[str], name: str) -> tuple[str, list[str]]:
        spaces = []
        for folder in folders:
            listed = self._listed(folder)
            path = f"{folder}/{name}"
            if name in listed:
                if "__init__.py" in self._listed(path):
                    return f"{path}/__init__.py", [path]
                spaces.append(path)
            for end in _ENDS:
                if f"{name}{end}" in listed:
                    return f"{path}{end}", []
        return "", [space for space in spaces if self._listed(space)]

    def _listed(self, folder: str) -> frozenset[str]:
        if folder not in self._lists:
            try:
                self._lists[folder] = frozenset(entry.name for entry in os.scandir(folder))
            except OSError:
                self._lists[folder] = frozenset()
        return self._lists[folder]


def _linked(sites: Iterable[Path]) -> Iterator[str]:
    """Yield the folders of packages that are installed as links to their sources."""
    for site in sites:
        for link in sorted(site.glob("*.pth")):
            for line in text_of(link).splitlines():
                if line.startswith("/") and Path(line.strip()).is_dir():
                    yield line.strip()
        for link in sorted(site.glob("__editable__*_finder.py")):
            for path in re.findall(r"'\w+': '([^']+)'", text_of(link).partition("NAMESPACES")[0]):
                yield str(Path(path).parent)


def is_installed(path: str) -> bool:
    """Return whether a file belongs to an installed package."""
    return not _INSTALLED.isdisjoint(path.split("/"))


class Found(msgspec.Struct):
    """Files of code.

    Attributes:
        files: Paths by their name for readers.
        installed: Names of installed packages that are imported.
        named: Names of files that are only named in a text, and may be read or written.
        folders: Paths of folders that are only named, by their name for readers.
    """

    files: dict[str, set[str]] = {}
    installed: set[str] = set()
    named: set[str] = set()
    folders: dict[str, set[str]] = {}

    def add(self, name: str, path: str) -> None:
        """Add a file."""
        self.files.setdefault(name, set()).add(path)


def find_sources(
    finder: Finder,
    modules: Iterable[str],
    scripts: Iterable[Path] = (),
    *,
    ours: Callable[[str], bool] = lambda _: True,
    possible: Iterable[str] = (),
    working: Iterable[Path] = (),
) -> Found:
    """Find the files of modules and scripts, and of all that they import.

    Args:
        modules: Their packages count with their files, even if they are installed.
        ours: Which of this project's modules count.
        possible: Names that may be modules.
        working: Folders in which paths in code may begin, beside those of its files.
    """
    sources = Found()
    working = list(working)
    todo = [*modules]
    roots = {name.partition(".")[0] for name in todo}
    todo += possible
    seen = {""}
    read: set[str] = set()

    def read_file(path: str, name: str, package: str) -> None:
        ours = name.partition(".")[0] in OURS and path.startswith(f"{TOOL}/")
        code = read_code(Path(path), whole=not ours)
        for level, module, names in code.imports:
            base = _absolute(level, module, package)
            todo.extend([base, *(f"{base}.{name}" for name in names)] if base else ())
        for reference in code.loaded:
            level = len(reference) - len(reference.lstrip("."))
            todo.append(_absolute(level, reference.lstrip("."), package) or reference)
        if ours:
            return
        folder = Path(path).parent
        if code.dynamic:
            todo.append(f"{package}.*" if package else "*")
            finder.add(str(folder))
        adds_folders = "sys.path" in text_of(Path(path))
        for text in code.texts:
            if match := _REFERENCE.fullmatch(text):
                todo.append(match[1])
            elif code.dynamic and _DOTTED.fullmatch(text):
                todo.append(text.lstrip("."))
            if ("." in text or "/" in text) and (beside := folder / text).is_file():
                named = beside.name if text.startswith("/") else text
                sources.named.add(named)
                add_script(str(beside), named)
            if adds_folders:
                others = (Path(os.path.normpath(up / text)) for up in (folder, folder.parent))
                for other in others:
                    if other.is_dir():
                        finder.add(str(other))

        for text, ups in code.places:
            for begin in dict.fromkeys([*(_up(folder, n) for n in ups), *working]):
                for place in _matches(begin, text):
                    is_code = _up(folder, 0).is_relative_to(place) or (
                        adds_folders and any(place.glob("*.py"))
                    )
                    if not is_code:
                        name_place(place, begin, file_too="*" in text or begin != folder)
        if code.of_stem:
            for place in _matches(folder, f"{Path(path).stem}.*"):
                name_place(place, folder, file_too=True)

    def name_place(place: Path, base: Path, *, file_too: bool) -> None:
        name = place.relative_to(base).as_posix() if place.is_relative_to(base) else place.name
        if place.is_dir():
            sources.folders.setdefault(name, set()).add(str(place))
        elif file_too and place.is_file() and place.suffix not in {".py", ".pyc", ".pyi"}:
            if name not in sources.files:
                sources.named.add(name)
            sources.add(name, str(place))

    def add_script(path: str, name: str) -> None:
        sources.add(name, path)
        if path not in read and (path.endswith(".py") or _is_python(path)):
            read.add(path)
            read_file(path, "", "")

    for script in scripts:
        add_script(str(script), script.name)
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        root = name.partition(".")[0]
        if name.endswith("*"):
            package = name.removesuffix("*").removesuffix(".")
            inside = finder.find(package)[1] if package else finder.first
            if root not in roots and any(map(is_installed, inside)):
                sources.installed.add(root)
            else:
                prefix = f"{package}." if package else ""
                todo += [prefix + submodule for submodule in finder.modules(inside)]
            continue
        file, folders = finder.find(name)
        place = file or next(iter(folders), "")
        if root not in roots and is_installed(place):
            sources.installed.add(root)
            continue
        if root in OURS and not ours(name):
            continue
        todo.append(name.rpartition(".")[0])
        if not file or file in read:
            continue
        read.add(file)
        parts = name.split(".")
        is_package = bool(folders)
        base = "/".join(parts if is_package else parts[:-1])
        sources.add(f"{base}/{Path(file).name}".lstrip("/"), file)
        if is_package:
            for entry in os.scandir(folders[0]):
                skipped = entry.name.endswith((".py", ".pyc", ".pyi")) or entry.path == str(RECORD)
                if not skipped and entry.is_file():
                    sources.add(f"{base}/{entry.name}", entry.path)
        read_file(file, name, name if is_package else ".".join(parts[:-1]))
    return sources


def _up(folder: Path, count: int) -> Path:
    return Path(os.path.normpath(folder.absolute().joinpath(*[".."] * count)))


def _matches(base: Path, text: str) -> list[Path]:
    """Return the files and folders that a path, or a pattern with ``*``, names in a folder.

    Of a pattern with a folder it is that folder; of one with very many files, none.
    """
    folder = text.partition("*")[0].rpartition("/")[0] if "*" in text else text
    with contextlib.suppress(OSError, ValueError):
        if not folder:
            paths = [*itertools.islice(base.glob(text), _MOST_MATCHES + 1)]
            return sorted(paths) if len(paths) <= _MOST_MATCHES else []
        path = Path(os.path.normpath(base / folder))
        return [path] if path.exists() else []
    return []


def _absolute(level: int, module: str, package: str) -> str:
    if not level:
        return module
    parts = package.split(".") if package else []
    if level - 1 > len(parts) or not parts:
        return module if not parts else ""
    return ".".join([*parts[: len(parts) - level + 1], *filter(None, [module])])


def _is_python(path: str) -> bool:
    first = text_of(Path(path)).partition("\n")[0]
    return first.startswith("#!") and "python" in first


def distributions(roots: Iterable[str], sites: Sequence[Path] | None = None) -> dict[str, str]:
    """Return version and hash of the distributions of installed packages, by their names.

    What they require counts, too, where it is installed.

    Args:
        roots: Names as imported: ``cv2``.
        sites: Folders of installed packages; by default those of this process.
    """
    if sites is None:
        sites = [Path(entry) for entry in dict.fromkeys(sys.path) if is_installed(entry)]
    known: dict[str, str] = {}
    for site in sites:
        with contextlib.suppress(OSError):
            for entry in sorted(entry.name for entry in os.scandir(site)):
                if entry.endswith((".dist-info", ".egg-info")):
                    known.setdefault(_normal(entry.partition("-")[0]), f"{site}/{entry}")
    roots = list(roots)
    provided = {name: _provides(info) for name, info in known.items()} if roots else {}
    todo = [name for root in roots for name in known if root in provided[name]]
    result: dict[str, str] = {}
    while todo:
        name = todo.pop()
        if name in result or name not in known:
            continue
        metadata = _metadata(known[name])
        if _normal(metadata.name) == "visnav-runtime":
            continue
        result[name] = f"{metadata.version} {_record_hash(known[name])}"
        todo += metadata.requires
    return result


class _Metadata(msgspec.Struct, frozen=True):
    name: str = ""
    version: str = ""
    requires: tuple[str, ...] = ()


def _metadata(info: str) -> _Metadata:
    for name in ("METADATA", "PKG-INFO"):
        with contextlib.suppress(OSError):
            return _once(f"{info}/{name}", _read_metadata)
    return _Metadata()


def _read_metadata(content: bytes) -> _Metadata:
    head = content.decode(errors="replace").replace("\r", "").partition("\n\n")[0]
    fields: dict[str, list[str]] = {}
    for line in head.splitlines():
        key, colon, value = line.partition(":")
        if colon:
            fields.setdefault(key, []).append(value.strip())
    requires = (
        _normal(match[0])
        for requirement in fields.get("Requires-Dist", [])
        if "extra ==" not in requirement and (match := re.match(r"[\w.-]+", requirement))
    )
    return _Metadata(fields.get("Name", [""])[0], fields.get("Version", [""])[0], tuple(requires))


def _provides(info: str) -> frozenset[str]:
    for name, make in (("RECORD", _roots_in), ("top_level.txt", _lines)):
        with contextlib.suppress(OSError):
            return _once(f"{info}/{name}", make)
    return frozenset({_normal(Path(info).name.partition("-")[0]).replace("-", "_")})


def _roots_in(content: bytes) -> frozenset[str]:
    roots = {line.partition(b",")[0].partition(b"/")[0] for line in content.splitlines()}
    return frozenset(root.decode(errors="replace").partition(".")[0] for root in roots)


def _lines(content: bytes) -> frozenset[str]:
    return frozenset(content.decode(errors="replace").split())


def _record_hash(info: str) -> str:
    with contextlib.suppress(OSError):
        return _once(f"{info}/RECORD", _hash_record)
    return ""


def _hash_record(content: bytes) -> str:
    """Return the hash of the files of a distribution, without those that installing makes."""
    made = (b".pyc,", b".dist-info/")
    lines = (
        line
        for line in content.splitlines()
        if not line.startswith(b"..") and not any(name in line for name in made)
    )
    return hashed(sorted(lines))[:16]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
