"""What is shipped works where it arrives: the wheel in a clean environment, examples, names."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from runtime.commit import commit
from runtime.config.reading import load
from runtime.tools.cli import inspect
from tests.runtime.tools.samples_cli import command_here

ROOT = Path(__file__).parents[1]
SCHEMA = json.loads((ROOT / "docs/reference/config.schema.json").read_text(encoding="utf-8"))
EXAMPLES = [*inspect.example_files().values()]


def python(
    code: str, folder: Path, *first: Path, executable: str | Path = sys.executable
) -> subprocess.CompletedProcess[str]:
    """Run a line of Python, or ``-m …``, in a folder, with these folders first on its path."""
    path = os.pathsep.join(map(str, (*first, ROOT)))
    words = code.split() if code.startswith("-m ") else ["-c", code]
    return subprocess.run(
        [str(executable), *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )


def test_another_package_called_events_is_named(tmp_path: Path) -> None:
    """Both commands end with one line that says which file stands in the way."""
    (tmp_path / "events.py").write_text("class Event: ...\n")
    for code in ("-m runtime nodes", "import visnav; visnav.main()"):
        done = python(code, tmp_path, tmp_path)
        assert done.returncode != 0
        (line,) = done.stderr.splitlines()
        assert "expected the package events of visnav-runtime" in line
        assert str(tmp_path / "events.py") in line


def test_another_package_called_runtime_is_named(tmp_path: Path) -> None:
    (tmp_path / "runtime").mkdir()
    (tmp_path / "runtime" / "__init__.py").write_text("")
    done = python("import visnav; visnav.main()", tmp_path, tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: expected the package runtime in ")
    assert str(tmp_path / "runtime" / "__init__.py") in line


@pytest.mark.slow
def test_the_console_command_is_the_command_line(tmp_path: Path) -> None:
    done = python("import sys, visnav; sys.argv[1:] = ['--help']; visnav.main()", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Fly a simulated vehicle" in done.stdout


def test_all_examples_are_listed_with_what_they_show() -> None:
    lines = command_here("example", folder=ROOT).stdout.splitlines()
    assert [line.split()[0] for line in lines] == [path.stem for path in EXAMPLES]
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_a_copied_example_is_whole(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that it reads comes along: it is as right in another folder.

    The schema is that of all nodes whatever the example: it is made for one only.
    """
    if path.stem != "config":
        monkeypatch.setattr(inspect, "schema", lambda out: out.write_text(json.dumps(SCHEMA)))
    done = command_here("example", path.stem, "--out", str(tmp_path), folder=ROOT)
    assert done.returncode == 0, done.stderr
    assert load(tmp_path / path.name).nodes
    named = re.match(r"#:schema (.*)\n", (tmp_path / path.name).read_text(encoding="utf-8"))
    assert named
    assert json.loads((tmp_path / named[1]).read_text(encoding="utf-8")) == SCHEMA
    beside = {"brightness": "brightness.py", "plain": "plain_room.xml"}
    beside |= {"computer_vision": "orbit.tum", "outside_cpp": "outside_cpp/odometry.cpp"}
    beside |= {"outside_ros2": "outside_ros2.py"}
    if path.stem in beside:
        assert (tmp_path / beside[path.stem]).is_file()
    again = command_here("example", path.stem, "--out", str(tmp_path), folder=ROOT)
    assert again.returncode == 2
    assert "expected no file of this name" in again.stderr


def test_an_example_that_is_not_there_is_guessed() -> None:
    done = command_here("example", "monoculer", folder=ROOT)
    assert done.returncode == 2
    assert "did you mean 'monocular'?" in done.stderr


def test_an_example_may_be_named_as_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspect, "schema", lambda _: None)
    done = command_here("example", "monocular.toml", "--out", str(tmp_path), folder=ROOT)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "monocular.toml").is_file()


@pytest.mark.parametrize("language", ["python", "cpp", "ros2"])
def test_a_new_estimator_is_whole(language: str, tmp_path: Path) -> None:
    """The examples are what it begins with, and these fly in the tests."""
    words = "new-estimator", "my_vio", "--language", language, "--out", str(tmp_path)
    done = command_here(*words, folder=ROOT)
    assert done.returncode == 0, done.stderr
    assert load(tmp_path / "my_vio.toml").run.name == "my_vio"
    source = "my_vio/my_vio.cpp" if language == "cpp" else "my_vio.py"
    texts = [(tmp_path / name).read_text(encoding="utf-8") for name in ("my_vio.toml", source)]
    assert not re.search(r"outside_|own_estimator|OwnEst|examples/", "".join(texts))
    assert f'"{Path(source).name}"' in texts[0] or '"my_vio:MyVio"' in texts[0]
    again = command_here(*words, folder=ROOT)
    assert (again.returncode, "found one" in again.stderr) == (2, True)


def test_a_new_estimator_has_a_name_that_a_module_may_have(tmp_path: Path) -> None:
    done = command_here("new-estimator", "my-vio", "--out", str(tmp_path), folder=ROOT)
    assert done.returncode == 2
    assert "expected a name of small letters, digits and _, found 'my-vio'" in done.stderr
    assert not [*tmp_path.iterdir()]


def built(folder: Path, out: Path, *options: str) -> list[Path]:
    """Build a distribution; return its wheels."""
    command = [sys.executable, "-m", "build", *options, "--outdir", str(out), str(folder)]
    subprocess.run(command, check=True, capture_output=True)
    return [*out.glob("*.whl")]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_wheel_works_in_a_clean_environment(tmp_path: Path) -> None:
    """Built, installed with what it needs and nothing else, and used away from the checkout.

    Then the extensions' wheels: their nodes and examples are there, which before were one line.
    """
    (wheel,) = built(ROOT, tmp_path / "dist")
    venv.create(tmp_path / "venv", with_pip=True)
    bin_ = tmp_path / "venv" / "bin"
    environment = {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    environment |= {"NO_COLOR": "1", "COLUMNS": "200"}
    (tmp_path / "work").mkdir()

    def done(*words: str | Path) -> str:
        finished = subprocess.run(
            list(map(str, words)),
            cwd=tmp_path / "work",
            env=environment,
            capture_output=True,
            text=True,
        )
        assert finished.returncode == 0, f"{words}: {finished.stderr}{finished.stdout}"
        return finished.stdout

    with zipfile.ZipFile(wheel) as content:
        noted = content.read("runtime/commit.txt").decode().strip()
        assert noted == commit()
        assert [name for name in content.namelist() if name.startswith("bench/")] == []
    done(bin_ / "pip", "install", "--quiet", wheel)
    visnav = bin_ / "visnav"
    assert "example" in done(visnav, "--help")
    assert "Multirotor" in done(visnav, "nodes")
    assert "monocular" in done(visnav, "example")
    done(visnav, "example", "brightness")
    done(visnav, "check", "brightness.toml")
    assert "--seeds" in done(visnav, "suite", "--help")
    shorter = [
        *("--set", "run.duration=3s", "--set", "run.shutdown_limit=60s"),
        *("--set", "camera.width=128", "--set", "camera.height=128"),
    ]
    judged = subprocess.run(
        [str(visnav), "demo", "--quiet", "--out", "tour", *shorter],
        cwd=tmp_path / "work",
        env=environment,
        capture_output=True,
        text=True,
    )
    assert judged.returncode in {0, 1}, judged.stderr  # three seconds need not pass
    folder = tmp_path / "work" / "tour"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["events"]["Image"] > 60
    assert summary["environment"]["commit"] == noted
    assert summary["code"].keys() == {"odometry"}
    assert (folder / "report.html").stat().st_size > 10_000
    foxglove = ROOT / "extensions" / "foxglove" / "examples" / "foxglove.toml"
    refused = subprocess.run(
        [str(visnav), "check", str(foxglove)], env=environment, capture_output=True, text=True
    )
    told = "FoxgloveServer is a node of the extension visnav-foxglove: pip install ./extensions/"
    assert refused.returncode == 2
    assert told in refused.stderr
    benchmarks = subprocess.run(
        [str(visnav), "bench"], env=environment, capture_output=True, text=True
    )
    assert benchmarks.returncode == 2
    assert "bench is a command of the extension visnav-bench" in benchmarks.stderr
    wheels = [
        wheel
        for extension in sorted(
            (*ROOT.glob("extensions/*/pyproject.toml"), ROOT / "bench" / "pyproject.toml")
        )
        for wheel in built(extension.parent, tmp_path / extension.parent.name, "--wheel")
    ]
    assert len(wheels) == 7
    done(bin_ / "pip", "install", "--quiet", *wheels)
    assert {"AirsimServer", "Mavlink", "OrbSlam3"} <= set(done(visnav, "nodes").split())
    measured = done(visnav, "bench", "small", "--nodes", "2", "--samples", "30", "--repeats", "1")
    assert "visnav, fingerprinted" in measured
    assert "asyncio-for-robotics (tcp): not installed" in measured
    for example in ("airsim", "foxglove", "mavsdk", "two_machines", "svo"):
        done(visnav, "example", example, "--out", example)
    for example in ("foxglove", "mavsdk", "two_machines"):
        done(visnav, "check", f"{example}/{example}.toml")
    short = "--set", "run.duration=1s", "--set", "foxglove.port=0"
    done(visnav, "run", "foxglove/foxglove.toml", "--quiet", *short)
