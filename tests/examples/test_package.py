"""The package of docs/how-to/package-nodes.md, built, installed and flown as a stranger's."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "examples" / "package"

PROGRAM = """
from nodes.outside.native.client import Link

with Link("ears") as link:
    (entry,) = [row for row in link.description["inputs"] if row["name"] == "airspeed"]
    link.log(f"row {entry['kind']} {entry['row']} {entry['row_bytes']}")
    link.ready("body")
    for frame in link:
        link.log(f"rows {frame.rows('airspeed')['airspeed'].tolist()}")
        link.done(frame)
"""

READ = """
from nodes.data.replay.node import open_reader
from nodes.data.replay.reader import Choice, ReplayConfig

reader = open_reader(ReplayConfig(file="set"), "drone")
(camera,) = [known for known in reader.announcements() if hasattr(known, "images")]
print(camera.source, camera.images, camera.info.width, camera.info.height, camera.rate)
for _, event in reader.events(0, None, Choice(("Event",))):
    what = event.position if hasattr(event, "position") else event.data.max()
    print(type(event).__name__, event.stamp, what)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the package installed in it."""
    folder = tmp_path_factory.mktemp("package")
    source = shutil.copytree(PACKAGE, folder / "source")  # its build leaves files beside it
    options = ["--no-deps", "--target", str(folder / "site")]
    command = [sys.executable, "-m", "pip", "install", "--quiet", *options, str(source)]
    subprocess.run(command, check=True, capture_output=True, timeout=200)
    return folder / "site"


def python(words: list[str], site: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, with the installed package on its path."""
    path = os.pathsep.join(map(str, (site, ROOT)))
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=50,
    )


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_packages_sensor_world_node_and_command_fly(site: Path, tmp_path: Path) -> None:
    """The measurements are recorded, exported, scored, and input of a program in its own rows."""
    (tmp_path / "ears.py").write_text(PROGRAM)
    process = (
        '\n[[nodes]]\nname = "ears"\ntype = "Process"\nimages = []\nasks = "airspeed"\n'
        f'command = ["{sys.executable}", "ears.py"]\n'
    )
    flight = (PACKAGE / "flight.toml").read_text(encoding="utf-8") + process
    (tmp_path / "flight.toml").write_text(flight, encoding="utf-8")
    done = python(["-m", "runtime", "run", "flight.toml", "--out", "run"], site, tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    announced = [entry for entry in summary["announcements"] if "Airspeed" in entry["type"]]
    assert [entry["source"] for entry in announced] == ["drone/airspeed"]
    log = (tmp_path / "run" / "log.txt").read_text(encoding="utf-8")
    assert "row airspeed [['airspeed', '<f8']] 16" in log
    assert re.search(r"rows \[\d", log)

    done = python(["-m", "runtime", "stall", "run"], site, tmp_path)
    assert done.returncode == 0, done.stderr
    slowest = re.fullmatch(r"drone\+airspeed: (\d\.\d\d) m/s\n", done.stdout)
    assert slowest
    assert 1.5 < float(slowest[1]) < 2.5  # standing in a wind of 2 m/s from ahead
    done = python(["-m", "runtime", "stall", "run", "--least", "9"], site, tmp_path)
    assert done.returncode == 1


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_packages_data_set_is_read(site: Path, tmp_path: Path) -> None:
    """Also images and depth images in a format that no other data set has."""
    for name, dtype in (("grey", np.uint8), ("depth", np.float32)):
        (tmp_path / "set" / name).mkdir(parents=True)
        for step in range(2):
            array = np.full((4, 6), 5 + step, dtype)
            np.save(tmp_path / "set" / name / f"{step}.npy", array)
    (tmp_path / "set" / "path.txt").write_text("0 0 -1\n1 0 -1\n")
    done = python(["-c", READ], site, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "drone/camera ('grey', 'depth') 6 4 10.0",
        "Odometry 0 (0.0, 0.0, -1.0)",
        "DepthImage 0 5.0",
        "Image 0 5",
        "Odometry 100000000 (1.0, 0.0, -1.0)",
        "DepthImage 100000000 6.0",
        "Image 100000000 6",
    ]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_package_that_is_torn_is_named(site: Path, tmp_path: Path) -> None:
    torn = shutil.copytree(site, tmp_path / "torn")
    (torn / "air_data" / "airspeed.py").write_text("import nowhere\n")
    (torn / "air_data" / "gate.py").unlink()
    done = python(["-m", "runtime", "check", str(ROOT / "config.toml")], torn, tmp_path)
    assert done.returncode == 2
    assert "airspeed of the package air-data: expected 'air_data.airspeed:" in done.stderr
    assert "No module named 'nowhere'" in done.stderr.splitlines()[-1]
