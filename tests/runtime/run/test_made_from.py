"""A run is known by all that it is made from, and what of it has changed is named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime import Node
from runtime.config.model import Config
from runtime.config.reading import load
from runtime.node import CommandLine
from runtime.run import made_from as module
from runtime.run.made_from import (
    Parts,
    Roots,
    changes,
    code_of,
    during,
    key_of,
    made_from,
    roots_of,
)
from runtime.run.results import MARKER
from runtime.run.sources import content_hash, distributions, read_code
from runtime.testing import spec
from tests.runtime.tools.samples_cli import ROOT

NODE = "from runtime import Node\n\n\nclass Own(Node):\n    pass\n"


def own(folder: Path, text: str = "") -> Roots:
    """Write a module, and return its roots; nothing is imported to know them.

    Its node imports nothing, as the runtime's hundred files take longer to read than all else.
    """
    (folder / "own.py").write_text(f"{text}\n\n\nclass Own:\n    pass\n", encoding="utf-8")
    return Roots(modules=("own",), folder=str(folder))


def of_file(folder: Path, name: str) -> tuple[Config, Roots]:
    """Write a file with a node of a module; its name is new, since others are imported by now."""
    path = folder / "c.toml"
    path.write_text(f"[[nodes]]\nname = 'own'\ntype = '{name}:Own'\n", encoding="utf-8")
    config = load(path)
    return config, roots_of(config, folder, [])


def program(folder: Path, *words: str, **options: tuple[str, ...]) -> Roots:
    """Return the roots of a node with a program."""
    line = CommandLine(words=words, folder=str(folder), **options)  # type: ignore[arg-type]
    return Roots(folder=str(folder), programs=(line,))


def what_changes(roots: Roots, change: Callable[[], object]) -> list[str]:
    """Return what a change changes, in words."""
    before = made_from(roots)
    assert changes(before, made_from(roots)) == []
    change()
    now = made_from(roots)
    assert (key_of(before) == key_of(now)) == (not changes(before, now))
    return changes(before, now)


def edit(path: Path) -> None:
    """Add a comment to a file, or change that by a letter, often within a tick of its clock."""
    content = path.read_bytes() if path.exists() else b""
    end = {b"1": b"2", b"2": b"1"}.get(content[-1:])
    path.write_bytes(content[:-1] + end if end else content + b"\n#1")


@pytest.mark.parametrize(
    ("code", "file"),
    [
        ("import helper", "helper.py"),
        ("from os import (\n    path,\n)\nfrom helper import (\n    it,\n)", "helper.py"),
        ("if TYPE_CHECKING:\n    import helper", "helper.py"),
        ("def later():\n  try:\n    x = 1; import helper\n  except ImportError: pass", "helper.py"),
        ("from parts import helper", "parts/helper.py"),
        ("from parts import first", "parts/deep/second.py"),
        ("import importlib\nimportlib.import_module('helper')", "helper.py"),
        ("import importlib\nimportlib.import_module(name='helper')", "helper.py"),
        ("def load(name):\n    return __import__('parts.' + name)", "parts/helper.py"),
        ("def load(name):\n    return import_module(f'parts.{name}')", "parts/helper.py"),
        ("def load(name):\n    return import_module(name)", "helper.py"),
        ("MODEL = 'helper:Model'", "helper.py"),
        ("WEIGHTS = 'weights.npz'", "weights.npz"),
        ("W = Path(__file__).parent / 'data' / 'net.bin'", "data/net.bin"),
        ("sys.path.insert(0, str(Path(__file__).parent / 'lib'))\nimport inner", "inner.py"),
        ("import ctypes\nctypes.CDLL('libfast.so')", "libfast.so"),
        ("import fast", "fast.so"),
    ],
)  # fmt: skip
def test_code_that_a_node_imports_or_loads_by_name_counts(
    code: str, file: str, tmp_path: Path
) -> None:
    for name in ("parts", "parts/deep", "data", "lib"):
        (tmp_path / name).mkdir()
    texts = {
        "parts/first.py": "from .deep import second",
        **dict.fromkeys(["helper.py", "weights.npz", "data/net.bin", "lib/inner.py"], "#"),
        **dict.fromkeys(["parts/__init__.py", "parts/helper.py", "parts/deep/second.py"], "#"),
        **dict.fromkeys(["libfast.so", "fast.so", "unrelated.py", "notes.txt"], "#"),
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    roots = own(tmp_path, code)
    place = "lib/inner.py" if file == "inner.py" else file
    assert what_changes(roots, lambda: edit(tmp_path / place)) == [f"{file} changed"]
    if "import_module(name)" not in code:  # whichever it is
        assert what_changes(roots, lambda: edit(tmp_path / "unrelated.py")) == []
    assert what_changes(roots, lambda: edit(tmp_path / "notes.txt")) == []


HERE = "HERE = Path(__file__).parent\n"


@pytest.mark.parametrize(
    ("code", "file", "expected"),
    [
        ("for f in (HERE / 'weights').glob('*.txt'): pass", "weights/a.txt", "weights"),
        ("MODELS = HERE / 'models'\nopen(MODELS / 'dir.bin')", "models/dir.bin", "models"),
        ("open(HERE.parent / 'data' / 'up.txt')", "../data/up.txt", "data/up.txt"),
        ("load(Path(__file__).resolve().parents[1] / 'data')", "../data/up.txt", "data"),
        ("load(dirname(dirname(__file__)) + '/x', '../data')", "../data/up.txt", "data"),
        ("np.load(Path(__file__).with_suffix('.npyy'))", "own.npyy", "own.npyy"),
        ("open(f'{HERE}/weights/{name}.txt')", "weights/a.txt", "weights"),
        ("open(f'weights/{name}.txt')", "weights/a.txt", "weights"),
        ("for f in HERE.glob('*.bin'): pass", "weights_1.bin", "weights_1.bin"),
        ("open(HERE / 'weights' / f'{name}.txt')", "weights/a.txt", "weights"),
        ("open(f'weights_{n}.bin')", "weights_1.bin", "weights_1.bin"),
        ("open(os.path.join(HERE, 'models', 'deep', name))", "models/deep/b.bin", "models/deep"),
        ("open(HERE.joinpath('models', name))", "models/deep/b.bin", "models"),
        ("open('weights/' + name)", "weights/a.txt", "weights"),
    ],
)
def test_data_that_code_reads_through_a_folder_or_a_computed_name_counts(
    code: str, file: str, expected: str, tmp_path: Path
) -> None:
    folder = tmp_path / "mine"
    for name in (
        "weights/a.txt", "models/dir.bin", "models/deep/b.bin", "../data/up.txt", "own.npyy",
        "weights_1.bin", "other/x.bin", "own.md",
    ):  # fmt: skip
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("1")
    roots = own(folder, HERE + code)
    assert what_changes(roots, lambda: edit(folder / file)) == [f"{expected} changed"]
    assert what_changes(roots, lambda: edit(folder / "other" / "x.bin")) == []


def test_folders_that_code_writes_into_or_that_a_run_changes_do_not_count(tmp_path: Path) -> None:
    code = "OUT = HERE / 'out'\nOUT.mkdir()\nLATER = HERE / 'later'\n"
    code += "open(HERE / 'logs' / 'a.csv', 'w')"
    roots = own(tmp_path, HERE + code)
    for name in ("out", "logs"):
        (tmp_path / name).mkdir()
        assert what_changes(roots, partial(edit, tmp_path / name / "a.csv")) == []
    before = made_from(roots)  # without it a run went well, and may have written it
    (tmp_path / "later").mkdir()
    assert changes(before, made_from(roots)) == []
    before = made_from(roots)
    edit(tmp_path / "later" / "x.txt")
    parts, edited = during(before, made_from(roots))
    assert edited == []
    assert changes(parts, made_from(roots)) == []


def test_folders_around_the_code_with_results_or_with_too_many_files_do_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_FILES", 3)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    folder = tmp_path / "mine"
    names = ["full/1", "full/2", "full/3", "full/4", "swept/rows.jsonl", "runs/1/x", "few/1"]
    for name in [*names, "../home/x"]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("1")
    texts = [
        "/",
        ".",
        "..",
        "../..",
        "full",
        "swept",
        "runs",
        "../home",
        str(tmp_path),
        "few",
        "/home",
        "/opt",
        "*/x",
        "../mine",
    ]
    (folder / "deep.yaml").write_text("root: .\nup: ..\n")
    roots = msgspec.structs.replace(
        program(folder, "python", "own.py", "deep.yaml", "."),
        modules=own(folder, f"TEXTS = {texts}").modules,
        folder=str(tmp_path / "settings"),
    )
    for name in [*names[:-1], "../home/x"]:
        assert what_changes(roots, lambda name=name: edit(folder / name)) == []  # type: ignore[misc]
    assert what_changes(roots, lambda: edit(folder / "few" / "1")) == ["few changed"]


def test_folders_that_a_settings_file_a_command_line_or_a_setting_names_count(
    tmp_path: Path,
) -> None:
    for name in ("cfg/w/a.bin", "weights/b.bin", "set/c.bin", "data/d.bin", "deep/x.bin"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    (tmp_path / "cfg" / "deep.yaml").write_text("weights: w\nroot: /\n")
    (tmp_path / "slam.py").write_text("open('data/' + name)")
    roots = program(tmp_path, "python", "slam.py", "--with=weights", "cfg/deep.yaml", ".")
    roots = msgspec.structs.replace(roots, texts=("set",))
    for name, expected in (
        ("cfg/w/a.bin", "cfg/w"), ("weights/b.bin", "weights"), ("set/c.bin", "set"),
        ("data/d.bin", "data"),
    ):  # fmt: skip
        assert what_changes(roots, partial(edit, tmp_path / name)) == [f"{expected} changed"]
    assert what_changes(roots, lambda: edit(tmp_path / "deep" / "x.bin")) == []


def test_files_that_a_node_writes_do_not_count(tmp_path: Path) -> None:
    code = "open('log.csv', 'w'); np.savetxt('poses.txt', x); open('in.csv')"
    roots = own(tmp_path, code)
    for path in (tmp_path / "log.csv", tmp_path / "poses.txt"):
        assert what_changes(roots, partial(path.write_text, "1")) == []
    (tmp_path / "in.csv").write_text("1")
    assert what_changes(roots, lambda: edit(tmp_path / "in.csv")) == ["in.csv changed"]
    assert what_changes(roots, (tmp_path / "in.csv").unlink) == ["in.csv is gone"]
    before = made_from(roots)  # with none of them a run went well
    (tmp_path / "in.csv").write_text("1")
    assert changes(before, made_from(roots)) == []


def test_the_own_file_counts_and_a_new_import_is_new(tmp_path: Path) -> None:
    roots = own(tmp_path)
    path = tmp_path / "own.py"
    (tmp_path / "later.py").write_text("", encoding="utf-8")

    def change() -> None:
        path.write_text(f"import later\n{path.read_text()}", encoding="utf-8")

    assert what_changes(roots, change) == [f"{path.name} changed", "later.py is new"]
    assert what_changes(roots, (tmp_path / "later.py").unlink) == ["later.py is gone"]


def test_a_package_of_ones_own_counts_with_its_data_and_without_caches(tmp_path: Path) -> None:
    package = tmp_path / "mine"
    (package / "__pycache__").mkdir(parents=True)
    for name in ("__init__.py", "net.npz", "other.py", "__pycache__/x.pyc"):
        (package / name).write_text("#", encoding="utf-8")
    roots = own(tmp_path, "import mine")
    assert what_changes(roots, lambda: edit(package / "net.npz")) == ["mine/net.npz changed"]
    assert what_changes(roots, lambda: edit(package / "other.py")) == []
    assert what_changes(roots, lambda: edit(package / "__pycache__" / "x.pyc")) == []


@pytest.mark.slow
def test_our_code_counts_by_its_place_in_the_project_and_many_files_by_its_name() -> None:
    parts = made_from(roots_of(load(ROOT / "config.toml"), ROOT))
    for name in (
        "events/base.py", "runtime/run/execute.py", "nodes/estimators/visual_odometry/__init__.py",
        "sims/worlds/tours.toml", "mujoco", "numpy", "opencv-python-headless", "python", "machine",
    ):  # fmt: skip
        assert name in parts, name
    assert not any(name.startswith(("/", "tests/", "bench/", "nodes/ros2/")) for name in parts)
    other = {k: f"{v}x" if k.startswith("runtime/") else v for k, v in parts.items()}
    assert changes(parts, other) == ["visnav-runtime changed"]
    two = parts | dict.fromkeys(["runtime/node.py", "events/base.py"], "x")
    assert changes(parts, two) == ["events/base.py changed", "runtime/node.py changed"]


@pytest.mark.slow
def test_after_the_first_time_the_key_costs_well_under_a_second() -> None:
    roots = roots_of(load(ROOT / "config.toml"), ROOT)
    made_from(roots)
    begin = time.process_time()
    made_from(roots)
    assert time.process_time() - begin < 0.3


def test_the_key_is_the_same_in_another_folder(tmp_path: Path) -> None:
    parts: list[Parts] = []
    for name in ("here", "there/deeper"):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        for file, text in (("slam.py", "import helper"), ("helper.py", ""), ("x.yaml", "a: 1")):
            (folder / file).write_text(text, encoding="utf-8")
        parts.append(made_from(program(folder, sys.executable, "slam.py", "--settings", "x.yaml")))
    assert {"slam.py", "helper.py", "x.yaml"} <= parts[0].keys()
    assert parts[0] == parts[1]


@pytest.mark.parametrize(
    ("settings", "file", "expected"),
    [
        ("world.xml", "world.xml", "world.xml"),
        ("world.xml", "meshes/rock.obj", "meshes/rock.obj"),
        ("world.xml", "part.xml", "part.xml"),
        ("world.xml", "skin.png", "skin.png"),
        ("mav0", "mav0/imu0/data.csv", "mav0"),
        ("bag.mcap", "bag.mcap", "bag.mcap"),
        ("lib.so", "lib.so", "lib.so"),
        ("plugin.py", "plugin.py", "plugin.py"),
        ("plugin.py", "helper.py", "helper.py"),
        ("tracker:Tracker", "tracker.py", "tracker.py"),
        ("tracker", "tracker.py", "tracker.py"),
    ],
)
@pytest.mark.parametrize("absolute", [True, False])
def test_files_folders_and_modules_that_settings_name_count(
    settings: str, file: str, expected: str, absolute: bool, tmp_path: Path
) -> None:
    files = {
        "world.xml": "<mujoco><compiler meshdir='meshes'/><include file='part.xml'/></mujoco>",
        "part.xml": '<asset><mesh file="rock.obj"/><texture file = "skin.png"/></asset>',
        "plugin.py": "import helper",
        **dict.fromkeys(["meshes/rock.obj", "skin.png", "bag.mcap", "lib.so", "helper.py"], "#"),
        **dict.fromkeys(["tracker.py", "mav0/imu0/data.csv", "unrelated.py"], "#"),
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    is_folder = settings == "mav0"  # whose path was made absolute where the file was read
    text = str(tmp_path / settings) if is_folder or (absolute and "." in settings) else settings
    roots = Roots(folder=str(tmp_path), texts=(text, "features", "/", "x" * 5000))
    assert what_changes(roots, lambda: edit(tmp_path / file)) == [f"{expected} changed"]
    assert what_changes(roots, lambda: edit(tmp_path / "unrelated.py")) == []


def test_results_of_runs_and_caches_in_a_folder_of_data_do_not_count(tmp_path: Path) -> None:
    names = ["runs/tour/1/log.txt", "sweeps/x/rows.jsonl", "__pycache__/a.pyc", ".git/index"]
    names += [f"made/{MARKER}", "made/log.txt", "mine/rows.jsonl", "mine/table.csv", "a.pyc"]
    data = tmp_path / "data"
    (data / "images").mkdir(parents=True)
    (data / "images" / "1.png").write_text("1")
    roots = Roots(inputs=(str(data),))

    def change() -> None:
        for name in names:
            (data / name).parent.mkdir(parents=True, exist_ok=True)
            (data / name).write_text("1")

    assert what_changes(roots, change) == []
    image = data / "images" / "1.png"
    assert what_changes(roots, partial(image.rename, data / "images" / "2.png")) == ["data changed"]


def test_large_files_count_by_size_and_time_and_so_do_files_of_large_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.run.sources.LARGE", 100)
    monkeypatch.setattr(module, "LARGE", 100)
    big = tmp_path / "big"
    big.mkdir()
    for name in ("a.bin", "b.bin"):
        (big / name).write_bytes(bytes(90))
    (tmp_path / "one.bin").write_bytes(bytes(200))
    roots = Roots(inputs=(str(big), str(tmp_path / "one.bin")))

    def rewrite() -> None:  # another content, of the same size and time
        for path in (big / "a.bin", tmp_path / "one.bin"):
            times = path.stat().st_atime_ns, path.stat().st_mtime_ns
            path.write_bytes(b"1" * path.stat().st_size)
            os.utime(path, ns=times)

    assert what_changes(roots, rewrite) == []
    assert what_changes(roots, lambda: os.utime(big / "b.bin", (1, 1))) == ["big changed"]
    assert what_changes(roots, lambda: os.utime(tmp_path / "one.bin", (1, 1))) == [
        "one.bin changed"
    ]


SCRIPT = '#!/bin/sh\n# starts it\nexec ./bin/slam --vocabulary voc.txt "$@"\n'


@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("python", "slam.py", "--settings", "x.yaml"), "slam.py"),
        (("python", "slam.py", "--settings", "x.yaml"), "helper.py"),
        (("python", "slam.py", "--settings", "x.yaml"), "x.yaml"),
        (("python", "slam.py", "--settings=x.yaml"), "x.yaml"),
        (("python", "slam.py", "settings:x.yaml"), "x.yaml"),
        (("python", "slam.py", "x.yaml"), "camera.yaml"),
        (("$VISNAV_PYTHON", "-u", "-X", "dev", "slam.py"), "helper.py"),
        (("python", "-m", "package.main"), "package/main.py"),
        (("python", "-m", "package.main"), "helper.py"),
        (("python", "-c", "import helper; helper.go()"), "helper.py"),
        (("./executable", "x.yaml"), "executable"),
        (("./executable",), "helper.py"),
        (("./run.sh",), "run.sh"),
        (("./run.sh",), "bin/slam"),
        (("./run.sh",), "voc.txt"),
        (("sh", "-c", "exec ./bin/slam x.yaml"), "bin/slam"),
        (("bin/slam", "./config"), "config"),
        (("tool", "x.yaml"), "bin/tool"),
    ],
)  # fmt: skip
def test_a_program_counts_with_the_files_of_its_command_line(
    words: tuple[str, ...], file: str, tmp_path: Path
) -> None:
    files = {
        "slam.py": "import helper\n",
        "executable": f"#!{sys.executable}\nimport helper\n",
        "run.sh": SCRIPT,
        "x.yaml": "cameras: 'camera.yaml'\noutput: $VISNAV_FOLDER/poses.txt\n",
        "package/main.py": "import helper",
        "config/a.yaml": "a: 1",
        "bin/tool": "#!/bin/sh\n",
        **dict.fromkeys(["helper.py", "camera.yaml", "voc.txt", "unrelated.yaml"], "#"),
        "package/__init__.py": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
        (tmp_path / name).chmod(0o755)
    shutil.copy("/bin/true", tmp_path / "bin" / "slam")
    environment = (("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}"),)
    roots = program(tmp_path, *words, environment=environment)  # type: ignore[arg-type]
    place = "config/a.yaml" if file == "config" else file
    edited = tmp_path / place
    assert what_changes(roots, lambda: edit(edited)) == [f"{file} changed"]
    assert what_changes(roots, lambda: edit(tmp_path / "unrelated.yaml")) == []


def test_a_file_given_by_a_variable_and_modules_of_pythonpath_count(tmp_path: Path) -> None:
    (tmp_path / "lib").mkdir()
    (tmp_path / "voc.bin").write_text("1")
    (tmp_path / "lib" / "client.py").write_text("")
    (tmp_path / "slam.py").write_text("import client")
    environment = (("PYTHONPATH", str(tmp_path / "lib")), ("VOCABULARY", "voc.bin"))
    roots = program(tmp_path, "python3", "slam.py", environment=environment)  # type: ignore[arg-type]
    assert what_changes(roots, lambda: edit(tmp_path / "voc.bin")) == ["voc.bin changed"]
    client = tmp_path / "lib" / "client.py"
    assert what_changes(roots, partial(edit, client)) == ["client.py changed"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_a_library_that_a_program_is_linked_with_counts(tmp_path: Path) -> None:
    """The program of a SLAM system is small, and what it does is in a library beside it."""
    (tmp_path / "lib.c").write_text("int answer(void) { return 41; }\n")
    (tmp_path / "main.c").write_text("int answer(void);\nint main(void) { return answer(); }\n")

    def build(*words: str) -> None:
        subprocess.run(["cc", *words], cwd=tmp_path, check=True)

    build("-shared", "-fPIC", "lib.c", "-o", "libslam.so")
    build("main.c", "-o", "slam", "-L.", "-lslam", "-Wl,-rpath,$ORIGIN")
    roots = program(tmp_path, "./slam")
    parts = made_from(roots)
    assert {"slam", "libslam.so", "system libraries of slam"} <= parts.keys()

    def change() -> None:
        (tmp_path / "lib.c").write_text("int answer(void) { return 42; }\n")
        build("-shared", "-fPIC", "lib.c", "-o", "libslam.so")

    assert what_changes(roots, change) == ["libslam.so changed"]


def test_of_a_program_that_is_built_the_sources_count_and_not_the_result(tmp_path: Path) -> None:
    (tmp_path / "include").mkdir()
    (tmp_path / "build").mkdir()
    for name in ("slam.cpp", "include/filter.hpp", "build/generated.cpp", "CMakeLists.txt"):
        (tmp_path / name).write_text("//")
    roots = program(tmp_path, "./slam", "x.yaml", build=("make", "all"))
    (tmp_path / "x.yaml").write_text("a: 1")
    assert what_changes(roots, lambda: shutil.copy("/bin/true", tmp_path / "slam")) == []
    assert what_changes(roots, lambda: edit(tmp_path / "build" / "generated.cpp")) == []
    for name in ("slam.cpp", "include/filter.hpp", "CMakeLists.txt", "x.yaml"):
        assert what_changes(roots, partial(edit, tmp_path / name)) == [f"{name} changed"]


def test_an_installed_distribution_counts_by_version_and_content(tmp_path: Path) -> None:
    site = tmp_path / "lib" / "python3" / "site-packages"
    for name, requires in (("fast-slam", "Requires-Dist: needed>=1\n"), ("needed", "")):
        info = site / f"{name.replace('-', '_')}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Name: {name}\nVersion: 1.0\n{requires}\n")
        module_name = name.replace("-", "")
        (info / "RECORD").write_text(
            f"{module_name}/__init__.py,sha256=abc,3\n{info.name}/RECORD,,\n"
            f"../../bin/{name},sha256=1,1\n{module_name}/__pycache__/x.pyc,,\n"
        )
    (site / "unrelated-2.0.dist-info").mkdir()
    before = distributions(["fastslam"], [site])
    assert {k: v.split()[0] for k, v in before.items()} == {"fast-slam": "1.0", "needed": "1.0"}
    record = site / "fast_slam-1.0.dist-info" / "RECORD"
    record.write_text(record.read_text().replace("fast-slam,sha256=1", "fast-slam,sha256=2"))
    assert distributions(["fastslam"], [site]) == before  # a start script names its interpreter
    record.write_text(record.read_text().replace("abc", "def"))
    assert changes(before, distributions(["fastslam"], [site])) == ["fast-slam changed"]


def test_a_package_installed_as_a_link_counts_by_its_files(tmp_path: Path) -> None:
    """For a program with an interpreter of its own; in ours the import system says where it is."""
    site = tmp_path / "venv" / "lib" / "python3.11" / "site-packages"
    site.mkdir(parents=True)
    (tmp_path / "venv" / "bin").mkdir()
    (tmp_path / "venv" / "bin" / "python").symlink_to(sys.executable)
    for name in ("src/linked", "other/mapped"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "__init__.py").write_text("#")
    (site / "linked.pth").write_text(f"{tmp_path / 'src'}\n")
    mapping = f"MAPPING: dict[str, str] = {{'mapped': '{tmp_path / 'other' / 'mapped'}'}}\n"
    (site / "__editable___mapped_1_finder.py").write_text(mapping)
    (tmp_path / "slam.py").write_text("import linked, mapped")
    roots = program(tmp_path, "venv/bin/python", "slam.py")
    for name in ("src/linked", "other/mapped"):
        file = tmp_path / name / "__init__.py"
        expected = [f"{Path(name).name}/__init__.py changed"]
        assert what_changes(roots, partial(edit, file)) == expected


def test_what_is_missing_odd_or_unreadable_is_no_error(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop" / "again").symlink_to(tmp_path / "loop")
    (tmp_path / "broken.py").write_text("def (:\n")
    (tmp_path / "latin.yaml").write_bytes(b"\xff\xfe: 1")
    texts = tuple(str(tmp_path / name) for name in ("pipe.yaml", "loop", "broken.py", "gone.xml"))
    odd = ("\0", "a" * 300, "latin.yaml", "./", "..", "$UNKNOWN/x", "--", "")
    roots = Roots(modules=("no.such.module", "."), folder=str(tmp_path), texts=(*texts, *odd))
    assert {"broken.py", "latin.yaml", "loop"} <= made_from(roots).keys()
    assert made_from(program(tmp_path, "no-such-program", *odd))
    assert made_from(program(tmp_path, "./broken.py", "pipe.yaml"))
    assert content_hash(tmp_path / "pipe.yaml") == "no file"
    assert read_code(tmp_path / "gone.py").imports == ()


HASHES = st.dictionaries(st.text(), st.text("0123456789abcdef", min_size=1))


@pytest.mark.slow
@given(HASHES, HASHES)
def test_keys_are_equal_where_nothing_changed_and_only_there(a: Parts, b: Parts) -> None:
    assert (key_of(a) == key_of(b)) == (changes(a, b) == []) == (a == b)


def test_an_edit_within_a_tick_of_the_files_clock_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "x.py"
    seen = set()
    for n in range(50):
        path.write_text(f"{n:03}")
        seen.add(content_hash(path))
    assert len(seen) == 50


@pytest.mark.slow
def test_the_code_of_an_estimator_is_its_class_with_local_imports_and_its_program(
    tmp_path: Path,
) -> None:
    (tmp_path / "own_with_code.py").write_text(f"import helper_of_own\n{NODE}")
    (tmp_path / "helper_of_own.py").write_text("")
    config, roots = of_file(tmp_path, "own_with_code")
    assert (roots.folder, roots.modules) == (str(tmp_path), ("own_with_code",))
    (own_spec,) = config.nodes
    hashes = [code_of(own_spec, tmp_path)]
    edit(tmp_path / "helper_of_own.py")
    hashes.append(code_of(own_spec, tmp_path))
    assert len({*hashes}) == 2
    (tmp_path / "slam.py").write_text("")
    text = (
        '[[nodes]]\nname = "slam"\ntype = "Process"\ncommand = ["python", "slam.py"]\nfolder = "."'
    )
    (tmp_path / "p.toml").write_text(text)
    (slam,) = load(tmp_path / "p.toml").nodes
    hashes = [code_of(slam)]
    edit(tmp_path / "slam.py")
    assert code_of(slam) not in hashes


def test_a_class_of_a_notebook_has_the_hash_of_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    class One(Node):
        """One."""

    class Other(Node):
        """Another."""

    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)
    keys = []
    for cls in (One, Other, One):
        monkeypatch.setattr(cls, "__module__", "__main__")
        monkeypatch.setattr("inspect.getsource", lambda cls: cls.__doc__)
        keys.append(code_of(spec(cls, "own")))
    assert keys[0] == keys[2] != keys[1]


def test_files_that_a_run_writes_into_its_arguments_are_no_part_of_it(tmp_path: Path) -> None:
    """But code and settings that somebody edits meanwhile are, and so are typed inputs."""
    names = ["poses.txt", "slam.py", "x.yaml", "world.obj"]
    for name in names:
        (tmp_path / name).write_text("")
    roots = msgspec.structs.replace(
        program(tmp_path, "python", "slam.py", "x.yaml", "poses.txt", "new.txt"),
        inputs=(str(tmp_path / "world.obj"),),
    )
    before = made_from(roots)
    for name in ("poses.txt", "new.txt"):
        edit(tmp_path / name)
    parts, edited = during(before, made_from(roots))
    assert edited == []
    assert before.keys() - parts.keys() == {"poses.txt"}
    assert changes(parts, made_from(roots)) == []
    for name in names[1:]:
        edit(tmp_path / name)
    assert during(before, made_from(roots))[1] == [f"{name} changed" for name in sorted(names[1:])]
