"""Reading by suffix, and images of meshes."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sims.scans.images import decode, to_srgb
from sims.scans.mesh_file import MeshError
from sims.scans.reading import read
from sims.scans.transforms import compose, determinant, moved, quaternion, rotation, scaling, turned
from tests.sims.scans import kit

RGBA = np.random.default_rng(0).integers(0, 256, (5, 7, 4), np.uint8)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scan.glb", r"scan.glb: expected a file to read, found: No such file"),
        ("scan.fbx", r"scan.fbx: expected a mesh file \(.dae, .glb, .*\), found '.fbx'"),
        ("scan", r"expected a mesh file .*, found no suffix"),
        (".", "expected a mesh file"),
    ],
)
def test_what_is_no_mesh_file_is_refused(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        read(tmp_path / name)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "scan.obj").mkdir()
    with pytest.raises(MeshError, match="expected a file to read, found: Is a directory"):
        read(tmp_path / "scan.obj")


@pytest.mark.parametrize("image", [RGBA, RGBA[..., :3], RGBA[..., 0]])
@pytest.mark.parametrize("deep", [False, True])
def test_images_are_eight_bits_of_rgb(image: kit.Array, deep: bool) -> None:
    stored = image.astype(np.uint16) * 257 if deep else image
    decoded = decode(kit.png(stored), "here")
    wanted = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
    assert np.array_equal(decoded, wanted)


def huge(suffix: str) -> bytes:
    data = bytearray(cv2.imencode(suffix, RGBA[..., :3])[1].tobytes())
    if suffix == ".png":
        data[16:24] = b"\x7f\xff\xff\xff" * 2
    elif suffix == ".jpg":
        at = data.index(b"\xff\xc0")
        data[at + 5 : at + 9] = b"\xff\xff" * 2
    elif suffix == ".bmp":
        data[18:26] = b"\xff\xff\xff\x7f" * 2
    else:
        assert data[12:16] == b"VP8L"
        data[21:25] = b"\xff\xff\xff\x0f"
    return bytes(data)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp"])
def test_an_image_of_a_damaged_size_takes_no_memory(suffix: str) -> None:
    with pytest.raises(MeshError, match="here: expected an image of at most 16384 x 16384 pixels"):
        decode(huge(suffix), "here")


@pytest.mark.parametrize("data", [b"", b"x", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xc0", b"BM"])
def test_what_is_no_image_is_refused(data: bytes) -> None:
    with pytest.raises(MeshError, match="here: expected a JPEG, PNG, WebP, BMP or TIFF"):
        decode(data, "here")


def test_srgb_is_the_inverse_of_linear_light() -> None:
    values = np.linspace(0, 1, 256)
    assert np.abs(to_srgb(kit.linear(values)) - values).max() < 1e-8
    assert to_srgb([-1.0, 0.0, 1.0, 2.0, np.nan]).tolist() == [0, 0, 1, 1, 0]


def test_transforms_are_those_of_linear_algebra() -> None:
    rng = np.random.default_rng(3)
    first, second = (np.eye(4) for _ in range(2))
    first[:3], second[:3] = rng.normal(size=(2, 3, 4))
    points = rng.normal(size=(9, 3))
    assert np.allclose(compose(first, second), first @ second)
    assert np.allclose(moved(points, first), points @ first[:3, :3].T + first[:3, 3])
    for matrix in (first, compose(first, scaling((-1, 1, 1)))):
        assert determinant(matrix) == pytest.approx(np.linalg.det(matrix[:3, :3]))
        normals = points @ np.linalg.inv(matrix[:3, :3])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        unit = turned(points, matrix)
        assert unit is not None
        assert np.allclose(unit, normals, atol=1e-6)
    axis, angle = np.array([1.0, -2.0, 0.5]), 0.7
    x, y, z = (np.sin(angle / 2) * axis / np.linalg.norm(axis)).tolist()
    assert np.allclose(rotation(axis, angle), quaternion(x, y, z, np.cos(angle / 2)))
    assert turned(np.zeros((1, 3)), np.eye(4)) is None
