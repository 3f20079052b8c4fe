"""Images of mesh files: decoding, search beside the mesh, and linear colours as sRGB."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import numpy.typing as npt

from sims.scans.mesh_file import MeshError
from sims.scans.parsing import LeftOut

Image = npt.NDArray[np.uint8]

MOST_PIXELS = 2**28
"""16384 × 16384: 0.8 GB."""


def decode(encoded: bytes, where: str) -> Image:
    """Decode a JPEG, PNG, WebP, BMP or TIFF to sRGB of shape (h, w, 3), or (h, w, 4) with alpha.

    The orientation that a camera writes into a JPEG is ignored, as texture coordinates ignore it.

    Raises:
        MeshError: It is none of these, is damaged, or is larger than `MOST_PIXELS`.
    """
    width, height = _size(encoded)
    # Without this, a damaged size costs gigabytes; no format packs a photograph that densely.
    if width * height > min(MOST_PIXELS, max(2**24, 8192 * len(encoded))):
        raise MeshError(
            f"{where}: expected an image of at most 16384 x 16384 pixels, found {width} x {height}"
        )
    try:
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # of an empty buffer, or by a codec
        image = None
    if image is None or image.size == 0:
        raise MeshError(
            f"{where}: expected a JPEG, PNG, WebP, BMP or TIFF, found {len(encoded)} bytes that "
            f"begin with {encoded[:8]!r}"
        )
    if image.dtype == np.uint16:
        image = (image // 257).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise MeshError(f"{where}: expected 8 or 16 bits a channel, found {image.dtype}")
    if image.ndim == 2 or image.shape[2] == 1:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    elif image.shape[2] == 2:
        grey, alpha = image[..., :1], image[..., 1:]
        image = np.concatenate([grey, grey, grey, alpha], axis=2)
    elif image.shape[2] == 4:
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)
    else:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return np.ascontiguousarray(image)


def find(name: str, folders: Iterable[Path]) -> Path | None:
    r"""Return the file that a mesh names, or None.

    A name may be percent-encoded, have backslashes, or be a path of the machine that wrote it
    (``C:\scan\wall.jpg``). It is sought in each folder as named, then by its last part in the
    folder and where textures usually are, in any case of letters.
    """
    name = name.strip().removeprefix("file://").replace("\\", "/")
    if not name or "\0" in name:
        return None
    folders = list(folders)
    for named in dict.fromkeys((name, unquote(name))):
        for folder in folders:
            if _is_file(folder / named):
                return folder / named
    last = unquote(name).rpartition("/")[2].lower()
    for folder in folders:
        for place in (".", "textures", "images", "../textures", "../materials/textures"):
            if not (folder / place).is_dir():
                continue
            for path in sorted((folder / place).iterdir()):
                if path.name.lower() == last and _is_file(path):
                    return path
    return None


class Images:
    """Images that a mesh names, each decoded once; one that cannot be shown is left out."""

    def __init__(self, folders: Iterable[Path], left_out: LeftOut) -> None:
        self._folders = tuple(folders)
        self._left_out = left_out
        self._images: dict[str, Image | None] = {}
        self.paths: list[Path] = []  # of the images that were found

    def load(self, name: str) -> Image | None:
        """Return the image of a name as the mesh has it, or None."""
        if name not in self._images:
            self._images[name] = self._decoded(name)
        return self._images[name]

    def _decoded(self, name: str) -> Image | None:
        path = find(name, self._folders)
        if path is None:
            self._left_out.note(f"image {name!r}", "not found; drawn in the material's colour")
            return None
        self.paths.append(path)
        try:
            return decode(path.read_bytes(), str(path))
        except (MeshError, OSError) as error:
            self._left_out.note(f"image {name!r}", f"drawn in the material's colour: {error}")
            return None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that is too long
        return False


def opaque(image: Image) -> Image:
    """Return an image without its alpha."""
    return np.ascontiguousarray(image[..., :3]) if image.shape[2] == 4 else image


def to_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Convert linear light from 0 to 1 to sRGB values (IEC 61966-2-1); what is outside is cut."""
    light = np.clip(np.nan_to_num(np.asarray(linear, np.float64)), 0.0, 1.0)
    srgb: npt.NDArray[np.float64] = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055
    )
    return srgb.round(9)  # powers differ in their last bits from one machine to the next


def _size(encoded: bytes) -> tuple[int, int]:
    """Return width and height as a file's header has them; (0, 0) if it has none that we know."""
    if encoded[:8] == b"\x89PNG\r\n\x1a\n" and len(encoded) >= 24:
        width, height = struct.unpack(">II", encoded[16:24])
        return width, height
    if encoded[:4] == b"RIFF" and encoded[8:12] == b"WEBP" and len(encoded) >= 30:
        if encoded[12:16] == b"VP8X":
            wide, high = encoded[24:27] + b"\0", encoded[27:30] + b"\0"
            return struct.unpack("<I", wide)[0] + 1, struct.unpack("<I", high)[0] + 1
        if encoded[12:16] == b"VP8L":
            packed = struct.unpack("<I", encoded[21:25])[0]
            return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        width, height = struct.unpack("<HH", encoded[26:30])
        return width & 0x3FFF, height & 0x3FFF
    if encoded[:2] == b"BM" and len(encoded) >= 26:
        width, height = struct.unpack("<ii", encoded[18:26])
        return abs(width), abs(height)
    if encoded[:2] != b"\xff\xd8":
        return 0, 0
    at = 2
    while at + 9 <= len(encoded):
        if encoded[at] != 0xFF:
            return 0, 0
        marker = encoded[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame
            height, width = struct.unpack(">HH", encoded[at + 5 : at + 9])
            return width, height
        at += 1 if marker == 0xFF else 2 + struct.unpack(">H", encoded[at + 2 : at + 4])[0]
    return 0, 0
