"""``run``, ``check`` and ``import`` of settings.json, from the command line."""

from __future__ import annotations

import contextlib
import itertools
import json
import signal
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest

from extensions.airsim.tests.scripts import Caller


def runtime(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "runtime", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def settings_file(folder: Path, settings: Any) -> Path:
    path = folder / "settings.json"
    path.write_text(settings if isinstance(settings, str) else json.dumps(settings))
    return path


def test_what_import_prints_is_toml_that_says_where_it_is_from(tmp_path: Path) -> None:
    settings_file(tmp_path, '{"ViewMode": "Fpv", // none\n "a\\nb = [": 1, "Wind": {"X": 1}}')
    done = runtime(tmp_path, "import", "settings.json", "--world", "yard")
    assert done.returncode == 0, done.stderr
    assert "warning: settings.json: line 1, column 21: AirSim itself refuses" in done.stderr
    assert "warning: settings.json: ViewMode: ignored: it changes only" in done.stderr
    assert done.stdout.startswith("# Made from settings.json by `python -m runtime import`")
    assert (
        "\n# settings.json: ViewMode: ignored: it changes only what Unreal shows\n" in done.stdout
    )
    drone, server, world = tomllib.loads(done.stdout)["nodes"]
    assert (drone["world"], world["wind"]["velocity"]) == ("yard", [1.0, 0.0, 0.0])
    assert json.loads(server["settings"])["Wind"] == {"X": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "settings"), [("import", "\xff"), ("import", ""), ("check", '{"SimMode": "Car"}')]
)
def test_what_is_wrong_is_one_line(settings: str, command: str, tmp_path: Path) -> None:
    settings_file(tmp_path, "").write_bytes(settings.encode("latin-1"))
    done = runtime(tmp_path, command, "settings.json")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: settings.json: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"SimMode": "ComputerVision"},
        {
            "Wind": {"Y": 2},
            "CameraDefaults": {"CaptureSettings": [{"Width": 64, "Height": 48}]},
            "Recording": {"Enabled": True, "Folder": "C:/x y"},
            "Vehicles": {
                "A": {
                    "VehicleType": "SimpleFlight",
                    "X": 2,
                    "Z": -1,
                    "Sensors": {"Lidar-1": {"SensorType": 6, "Enabled": True, "Range": 20}},
                    "Cameras": {"eye": {"CaptureSettings": [{"ImageType": 1}]}},
                },
                "B": {"VehicleType": "SimpleFlight", "Yaw": 90},
            },
        },
    ],
)
def test_check_accepts_settings_and_what_import_makes_of_them(
    settings: Any, tmp_path: Path
) -> None:
    settings_file(tmp_path, settings)
    done = runtime(tmp_path, "import", "settings.json")
    (tmp_path / "config.toml").write_text(done.stdout)
    for file in ("settings.json", "config.toml"):
        done = runtime(tmp_path, "check", file)
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_script_flies_the_default_settings(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    settings_file(tmp_path, {"ApiServerPort": port})
    running = subprocess.Popen(
        [sys.executable, "-m", "runtime", "run", "settings.json", "--quiet"], cwd=tmp_path
    )
    try:
        airsim = None
        until = time.monotonic() + 50.0
        while airsim is None and time.monotonic() < until:
            with contextlib.suppress(ConnectionRefusedError):
                airsim = Caller(port)
            time.sleep(0.1)  # the run comes up in another process
        assert airsim is not None
        airsim("enableApiControl", True, "SimpleFlight")
        airsim("startRecording")
        assert airsim("takeoff", 20.0, "SimpleFlight") is True
        airsim("stopRecording")
        assert airsim("simGetVehiclePose", "")["position"]["z_val"] < -1.5
        assert airsim("getGpsData", "gps", "")["gnss"]["geo_point"]["altitude"] > 123.0
        assert json.loads(airsim("getSettingsString")) == {"ApiServerPort": port}
        airsim.close()
    finally:
        running.send_signal(signal.SIGINT)
        assert running.wait(30) == 0
    (table,) = (tmp_path / "runs/airsim/latest/recording").glob("*/airsim_rec.txt")
    header, *rows = (line.split("\t") for line in table.read_text().splitlines())
    stamps = [int(row[header.index("TimeStamp")]) for row in rows]
    assert {after - before for before, after in itertools.pairwise(stamps)} == {50}
    assert float(rows[-1][header.index("POS_Z")]) < -1.5
    images = {image.name for image in table.parent.glob("images/*.png")}
    assert {row[header.index("ImageFile")] for row in rows} == images
