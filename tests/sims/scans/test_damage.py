"""A damaged file is read or refused with a sentence: no other error, no hang, no memory."""

import json
import random
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sims.scans.mesh_file import MeshError
from sims.scans.reading import read
from tests.sims.scans import kit
from tests.sims.scans.test_formats import OTHERS, SCENE, write

WORDS = [b"-1", b"0", b"3000000000", b"99999999999999999999", b"1e309", b"nan", b'"x"', b"[]", b"x"]
VALUES: list[Any] = [-1, 0, 2**31, 10**20, 1e300, None, True, "x", [], {}, [None], {"x": 1}, 0.5]


def damaged(data: bytes, random: random.Random) -> bytes:
    """Cut a file, turn bits, put another number into its text, or move a part of it."""
    changed = bytearray(data)
    kind = random.randrange(4)
    if kind == 0:
        return data[: random.randrange(len(data))]
    if kind == 1:
        for _ in range(random.randrange(1, 6)):
            changed[random.randrange(len(data))] ^= 1 << random.randrange(8)
        return bytes(changed)
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", data))
    if kind == 2 and numbers:
        number = random.choice(numbers)
        return data[: number.start()] + random.choice(WORDS) + data[number.end() :]
    start, to = random.randrange(len(data)), random.randrange(len(data))
    return data[:to] + data[start : start + random.randrange(1, 40)] + data[to:]


def read_or_refuse(path: Path) -> bool:
    """Return whether a file was refused; any other error than `MeshError` is raised."""
    try:
        read(path)
    except MeshError:
        return True
    return False


@pytest.mark.parametrize(
    ("name", "victim"),
    [
        *((name, "") for name in ("u2.glb", "draco.glb", "inside.gltf", *OTHERS, "room.world")),
        ("room.obj", "room.mtl"),
        ("room.world", "models/room/model.sdf"),
        ("room.world", "models/room/model.config"),
        ("room.world", "models/room/meshes/room.dae"),
    ],
)
def test_a_damaged_file_is_read_or_refused(tmp_path: Path, name: str, victim: str) -> None:
    path = write(tmp_path, name)
    target = tmp_path / victim if victim else path
    whole = target.read_bytes()
    refused = 0
    for seed in range(12):
        target.write_bytes(damaged(whole, random.Random(f"{name} {seed}")))
        refused += read_or_refuse(path)
    assert refused or target.suffix in (".mtl", ".stl")


def slots(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each place of a JSON document as its container and key."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in list(items):
        yield value, key
        if isinstance(inner, dict | list):
            yield from slots(inner)


@pytest.mark.parametrize("kind", ["plain", "draco", "quantized"])
def test_any_other_value_in_a_gltf_is_read_or_refused(tmp_path: Path, kind: str) -> None:
    made = kit.gltf(SCENE, draco=kind == "draco", quantized=kind == "quantized")
    made.glb()
    text = json.dumps(made.document)
    path = tmp_path / "room.glb"
    count = len(list(slots(json.loads(text))))
    refused = 0
    for seed in range(25):
        rng = random.Random(f"{kind} {seed}")
        made.document = json.loads(text)
        container, key = list(slots(made.document))[rng.randrange(count)]
        container[key] = rng.choice(VALUES)
        path.write_bytes(repacked(made))
        refused += read_or_refuse(path)
    assert refused > 8


def repacked(made: kit.Gltf) -> bytes:
    """Return a GLB of a document as it is."""
    text = json.dumps(made.document).encode()
    text += b" " * (-len(text) % 4)
    binary = bytes(made.data) + b"\0" * (-len(made.data) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
