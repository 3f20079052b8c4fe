"""Survey of a mesh file: what it says, draws, and writes to be flown."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from runtime.config.reading import load
from runtime.tools.cli import app
from runtime.tools.preflight import of_nodes
from tests.sims.scans.test_scan_world import write_room


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return write_room(tmp_path / "my room.obj")


def test_a_room_is_described_drawn_and_flown(room: Path) -> None:
    arguments = ["world", room.name, "--set", "up=y", "--config", "fly.toml"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    lines = dict(line.partition(": ")[::2] for line in result.output.splitlines())
    assert lines["my room.obj"] == "24 triangles, 2 objects, 0 images"
    assert lines["extent"] == "north -4.00 to 4.00, east -3.00 to 3.00, height 0.00 to 3.00 m"
    assert lines["ground"] == "a plane at a height of 0.00 m"
    assert 60.0 < float(lines["free"].removesuffix(" m³")) < 8.0 * 6.0 * 3.0
    assert lines["images"] == "my room-world.png"
    sheet = cv2.imdecode(np.fromfile("my room-world.png", np.uint8), cv2.IMREAD_COLOR)
    assert sheet is not None
    assert sheet.shape[0] == 720
    settings = load(Path("fly.toml"))
    assert settings.run.name == "my_room"
    assert of_nodes(settings).errors == []
    assert settings.nodes[0].config.mesh.up == "y"  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["none.glb"], "none.glb: expected a mesh file, found nothing"),
        (["my room.obj", "--set", "unit=yard"], "unit: expected"),
        (["my room.obj", "--config", "my room.obj"], "expected no such file, found one"),
        (["my room.obj", "--image", "none/x.png"], "none/x.png: expected a file to write"),
    ],
)
def test_what_is_wrong_is_said(room: Path, arguments: list[str], error: str) -> None:
    with pytest.raises(Exception, match=error):
        CliRunner().invoke(app, ["world", *arguments], catch_exceptions=False)
    assert room.exists()


def test_a_mesh_without_room_for_a_vehicle_is_drawn_from_its_middle(room: Path) -> None:
    arguments = ["world", room.name, "--set", "up=y", "--set", "unit=0.05"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert "free: a vehicle fits nowhere" in result.output
    assert Path("my room-world.png").exists()
    with pytest.raises(Exception, match="expected room for a vehicle"):
        CliRunner().invoke(app, [*arguments, "--config", "a.toml"], catch_exceptions=False)


def test_a_floor_at_another_height_is_where_the_flight_starts(room: Path) -> None:
    arguments = ["world", room.name, "--set", "up=y", "--set", "position=[0, 0, -2]"]
    CliRunner().invoke(app, [*arguments, "--config", "fly.toml"], catch_exceptions=False)
    settings = load(Path("fly.toml"))
    assert settings.nodes[0].config.height == 2.0  # type: ignore[attr-defined]
    assert of_nodes(settings).errors == []


def test_a_room_whose_faces_point_outwards_is_named_with_the_setting(room: Path) -> None:
    """Once: not of the room as it is, nor if its triangles are seen from both sides."""

    def notes(*more: str) -> list[str]:
        arguments = ["world", room.name, "--set", "up=y", *more]
        result = CliRunner().invoke(app, arguments, catch_exceptions=False)
        return [line for line in result.output.splitlines() if "faces point outwards" in line]

    assert notes() == []
    lines = room.read_text(encoding="utf-8").splitlines()
    turned = [
        " ".join(["f", *reversed(line.split()[1:])]) if line.startswith("f ") else line
        for line in lines
    ]
    room.write_text("\n".join(turned) + "\n", encoding="utf-8")
    for floor in ("auto", "0.0"):  # by itself it takes the roof for the ground
        (note,) = notes("--set", f"floor={floor}")
        assert note.endswith("double_sided = true draws them")
        assert notes("--set", f"floor={floor}", "--set", "double_sided=true") == []
