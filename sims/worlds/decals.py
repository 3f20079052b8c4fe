"""Things painted or hung on a surface: posters, crates' faces, windows, letters, house fronts.

Each function returns an image (float32 RGB in 0..1) or changes one.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from sims.worlds import materials
from sims.worlds.materials import Canvas, Colour, Image, mix, planks, shade, share, smooth

WORDS = (
    "DEPTH", "PARALLAX", "HORIZON", "LOOP", "FLOW", "EPIPOLE", "INERTIA", "KEYFRAME", "ORBIT",
    "VECTOR", "SCALE", "RANSAC",
)  # fmt: skip
INKS: tuple[tuple[Colour, Colour, Colour], ...] = (
    ((0.91, 0.86, 0.74), (0.76, 0.22, 0.16), (0.12, 0.18, 0.26)),
    ((0.14, 0.24, 0.34), (0.93, 0.68, 0.24), (0.90, 0.88, 0.80)),
    ((0.83, 0.83, 0.76), (0.16, 0.42, 0.40), (0.84, 0.36, 0.16)),
    ((0.82, 0.40, 0.22), (0.95, 0.88, 0.70), (0.16, 0.13, 0.15)),
    ((0.22, 0.36, 0.27), (0.92, 0.84, 0.60), (0.80, 0.28, 0.22)),
    ((0.88, 0.78, 0.40), (0.20, 0.24, 0.38), (0.72, 0.24, 0.22)),
)
Box = tuple[int, int, int, int]  # left, top, right, bottom; pixels


def letters(image: Image, text: str, where: Box, colour: Colour, worn: Image | None) -> None:
    """Write `text` as large as `where` allows; `worn` (h, w of the image) thins the paint."""
    left, top, right, bottom = where
    face = cv2.FONT_HERSHEY_DUPLEX
    (wide, high), _ = cv2.getTextSize(text, face, 1.0, 2)
    scale = min((right - left) / wide, (bottom - top) / (high * 1.1))
    stencil = np.zeros(image.shape[:2], np.uint8)
    start = (int((left + right - wide * scale) / 2.0), int((top + bottom + high * scale) / 2.0))
    thick = max(1, round(3.2 * scale))
    cv2.putText(stencil, text, start, face, scale, 255, thick, cv2.LINE_AA)
    mask = share(stencil)
    if worn is not None:
        mask = mask * worn
    image[:] = mix(image, colour, mask)


def poster(on: Canvas, number: int) -> Image:
    """Return a printed poster: composition, inks and word by `number`."""
    height, width = on.shape
    paper, ink, second = INKS[number % len(INKS)]
    sheet = share(_composition(on, number))
    margin = width // 12
    word = WORDS[number % len(WORDS)]
    letters(
        sheet, word, (margin, int(height * 0.74), width - margin, int(height * 0.87)), second, None
    )
    for line in range(3):
        y = int(height * (0.90 + 0.025 * line))
        end = int(width * on.random.uniform(0.5, 0.9))
        cv2.line(sheet, (margin, y), (end, y), ink, 1)
    sheet = shade(sheet, 0.05 * on.fractal(coarse=width / 2))
    sheet = shade(sheet, 0.18 * on.specks(count=40, radius=(1.0, 4.0)))
    sheet = mix(sheet, paper, 0.06)
    cv2.rectangle(sheet, (0, 0), (width - 1, height - 1), (0.15, 0.13, 0.12), 4)
    return sheet


def _composition(on: Canvas, number: int) -> npt.NDArray[np.uint8]:
    height, width = on.shape
    paper, ink, second = (
        tuple(round(255 * part) for part in colour) for colour in INKS[number % len(INKS)]
    )
    sheet = np.full((height, width, 3), paper, np.uint8)
    centre = (
        int(width * on.random.uniform(0.35, 0.65)),
        int(height * on.random.uniform(0.3, 0.45)),
    )
    kind = number % 4
    if kind == 0:
        for index, radius in enumerate(np.linspace(0.42, 0.06, 6) * width):
            colour = (ink, paper, second)[index % 3]
            cv2.circle(sheet, centre, int(radius), colour, -1, cv2.LINE_AA)
    elif kind == 1:
        for index in range(9):
            x = int(width * index / 9)
            y = int(height * on.random.uniform(0.15, 0.62))
            colour = (ink, second)[index % 2]
            cv2.rectangle(sheet, (x, y), (x + width // 11, int(height * 0.7)), colour, -1)
        cv2.circle(sheet, (int(width * 0.75), int(height * 0.18)), width // 9, ink, -1, cv2.LINE_AA)
    elif kind == 2:
        for index in range(14):
            points = on.random.uniform((0.05, 0.05), (0.95, 0.68), (3, 2)) * (width, height)
            colour = (ink, second, paper)[index % 3]
            cv2.fillPoly(sheet, [points.astype(np.int32)], colour, cv2.LINE_AA)
    else:
        for row in range(7):
            for column in range(6):
                at = (int(width * (column + 0.6) / 6.2), int(height * (row + 0.7) / 10.5))
                radius = int(width * on.random.uniform(0.02, 0.075))
                cv2.circle(sheet, at, radius, (ink, second)[(row + column) % 2], -1, cv2.LINE_AA)
    return sheet


def posters(on: Canvas) -> Image:
    """Return twelve posters of the canvas's shape, in rows of four."""
    return sheets([poster(on, number) for number in range(12)], 4)


def crate_faces(on: Canvas) -> Image:
    """Return nine crates' sides of the canvas's shape, in rows of three."""
    return sheets([crate_face(on, number) for number in range(9)], 3)


def sheets(images: list[Image], columns: int) -> Image:
    """Lay out images of equal size in rows."""
    rows = [np.concatenate(images[i : i + columns], 1) for i in range(0, len(images), columns)]
    return np.concatenate(rows, 0)


def crate_face(on: Canvas, number: int) -> Image:
    """Return a side of a wooden crate: boards, a frame, a brace, a stencilled mark."""
    size, random = on.shape[0], on.random
    wood = on._replace(density=size * 0.9)
    tint = random.uniform(0.85, 1.12, 3)
    tone = tuple(
        tuple(float(c) for c in np.asarray(colour) * tint)
        for colour in ((0.66, 0.50, 0.31), (0.58, 0.42, 0.26), (0.72, 0.56, 0.37))
    )
    face = planks(wood, palette=tone, width=0.19)  # type: ignore[arg-type]
    if number % 2:
        face = np.ascontiguousarray(face.transpose(1, 0, 2))
    frame = planks(wood, palette=tone, width=0.5)  # type: ignore[arg-type]
    edge = int(size * 0.11)
    boards = np.zeros(on.shape, np.uint8)
    if number % 3 != 2:
        band = int(size * 0.10)
        cv2.line(boards, (edge, size - edge), (size - edge, edge), 255, band, cv2.LINE_AA)
    boards[:edge] = boards[-edge:] = 255
    boards[:, :edge] = boards[:, -edge:] = 255
    mask = share(boards)
    rim = cv2.dilate(mask, np.ones((3, 3), np.uint8)) - mask
    rim = np.maximum(rim, np.roll(np.roll(rim, 2, 0), 1, 1) * (1.0 - mask))
    face = mix(mix(face, frame * 0.92, mask), (0.12, 0.08, 0.05), rim * 0.85)
    for x in (edge // 2, size - edge // 2):
        for y in np.linspace(edge // 2, size - edge // 2, 5):
            cv2.circle(face, (x, int(y)), max(1, size // 110), (0.15, 0.13, 0.12), -1)
    worn = smooth(-1.6, -0.2, on.fractal(coarse=size / 6))
    ink = ((0.10, 0.10, 0.10), (0.55, 0.12, 0.10), (0.12, 0.20, 0.36))[number % 3]
    text = f"{'ABCDEFGH'[number % 8]}-{random.integers(100, 999)}"
    inset = int(size * 0.2)
    low = int(size * (0.25 if number % 2 else 0.6))
    letters(face, text, (inset, low, size - inset, low + size // 6), ink, worn)
    return face


def window_pane(on: Canvas, lit: bool) -> Image:
    """Return a framed window; its panes reflect the sky, or are lit from within."""
    height, width = on.shape
    fall = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    top, bottom = (
        ((0.98, 0.86, 0.58), (0.80, 0.62, 0.36))
        if lit
        else ((0.68, 0.78, 0.86), (0.30, 0.38, 0.46))
    )
    glass = np.asarray(top, np.float32) * (1 - fall) + np.asarray(bottom, np.float32) * fall
    glass = np.ascontiguousarray(np.broadcast_to(glass, (height, width, 3)))
    columns, rows = max(2, width // 26), max(2, height // 30)
    panes = on.random.uniform(0.68, 1.12, (rows, columns)).astype(np.float32)
    glass *= cv2.resize(panes, (width, height), interpolation=cv2.INTER_NEAREST)[..., None]
    streak = on.fractal(coarse=width / 3, stretch=(2.0, 1.0))
    glass = shade(glass, 0.10 * streak)
    bar = (0.22, 0.23, 0.24)
    for column in range(columns + 1):
        x = round(column * (width - 1) / columns)
        cv2.line(glass, (x, 0), (x, height), bar, 2)
    for row in range(rows + 1):
        y = round(row * (height - 1) / rows)
        cv2.line(glass, (0, y), (width, y), bar, 2)
    return glass


def paste(image: Image, piece: Image, left: int, top: int, border: int = 0) -> None:
    """Paste a piece into an image, with a shadow line around the piece."""
    height, width = piece.shape[:2]
    if border:
        end = (left + width + border - 1, top + height + border - 1)
        cv2.rectangle(image, (left - border, top - border), end, (0.30, 0.28, 0.26), -1)
    image[top : top + height, left : left + width] = piece


def stripes(image: Image, where: Box, worn: Image) -> None:
    """Paint yellow and black warning stripes."""
    left, top, right, bottom = where
    ys, xs = np.mgrid[top:bottom, left:right].astype(np.float32)
    phase = ((xs + ys) / 14.0) % 1.0
    soft = smooth(0.42, 0.5, phase) - smooth(0.92, 1.0, phase)
    band = mix(np.full((*phase.shape, 3), (0.88, 0.68, 0.14), np.float32), (0.12, 0.12, 0.12), soft)
    part = image[top:bottom, left:right]
    part[:] = mix(part, band, worn[top:bottom, left:right] * 0.9)


def contact_shadow(image: Image, footprints: Image, reach: float, strength: float) -> Image:
    """Darken a floor under and around objects; `footprints` is a mask in 0..1."""
    wide = cv2.GaussianBlur(footprints, (0, 0), reach)
    close = cv2.GaussianBlur(footprints, (0, 0), reach / 4.0)
    return shade(image, -strength * np.clip(0.6 * wide + 0.5 * close, 0.0, 1.0))


def tile(number: int, columns: int, rows: int) -> tuple[float, float, float, float]:
    """Return the window of an image of `sheets`, by number, a hair inside its edges."""
    row, column = divmod(number % (columns * rows), columns)
    hair = 0.002
    left, top = column / columns + hair, row / rows + hair
    return left, top, (column + 1) / columns - hair, (row + 1) / rows - hair


STOREY = 3.1  # height of a storey, metres
PAINTS: tuple[Colour, ...] = (
    (0.80, 0.70, 0.52), (0.70, 0.46, 0.36), (0.66, 0.72, 0.68), (0.84, 0.80, 0.70),
    (0.60, 0.64, 0.72), (0.78, 0.60, 0.44),
)  # fmt: skip
BRICKS = (materials.RED_BRICK, materials.YELLOW_BRICK, materials.GREY_STONE)


def height_of(storeys: int) -> float:
    """Return the height of a house front, metres."""
    return storeys * STOREY + 1.0


def house(
    width: float, storeys: int, random: np.random.Generator, density: float, number: int
) -> Image:
    """Return a house front `width` metres wide at `density` pixels per metre."""
    height = height_of(storeys)
    shape = (int(height * density), int(width * density))
    on = Canvas(shape, random, density)
    bare = materials.brick(on, BRICKS[number % 3], (0.17, 0.42))
    front = bare
    if number % 2:
        paint = PAINTS[int(random.integers(len(PAINTS)))]
        front = materials.plaster(on, paint, bare)
        front = shade(front, 0.4 * (bare.mean(2) - float(bare.mean())))
    spacing = float(random.uniform(1.9, 2.4))
    columns = max(2, int((width - 0.8) / spacing))
    margin = (width - columns * spacing) / 2.0
    size = (int(1.6 * density), int(1.05 * density))
    door = int(random.integers(columns))
    for storey in range(storeys):
        top = int((height - (storey + 1) * STOREY + 0.75) * density)
        for column in range(columns):
            left = int((margin + (column + 0.5) * spacing - 0.52) * density)
            if storey == 0 and column == door:
                _door(front, left, int((height - 2.3) * density), density, random)
                continue
            pane = window_pane(Canvas(size, random), lit=bool(random.uniform() < 0.18))
            if random.uniform() < 0.35:
                blind = int(size[0] * random.uniform(0.2, 0.6))
                pane[2:blind, 2:-2] = np.asarray(PAINTS[int(random.integers(6))], np.float32) * 0.9
            paste(front, pane, left, top, border=max(2, int(0.07 * density)))
            sill = top + size[0] + 3
            front[sill : sill + 4, left - 4 : left + size[1] + 4] = (0.78, 0.76, 0.71)
            front[sill + 4 : sill + 7, left - 3 : left + size[1] + 3] *= 0.55
        if storey:
            line = int((height - storey * STOREY) * density)
            front[line - 3 : line + 3] = front[line - 3 : line + 3] * 0.4 + 0.42
            front[line + 3 : line + 6] *= 0.6
    if number % 3 == 1 and columns > 2:
        _sign(front, density, random, number)
    front[: int(0.22 * density)] = (0.40, 0.38, 0.36)
    front[int(0.22 * density) : int(0.34 * density)] *= 0.5
    for x in (4, shape[1] - 8):
        cv2.line(front, (x, 8), (x, shape[0]), (0.30, 0.31, 0.32), 3)
    rise = np.arange(shape[0], 0, -1, dtype=np.float32)[:, None] / density
    damp = on.fractal(coarse=2.0 * density, fine=4, stretch=(3.0, 1.0))
    front = mix(front, (0.26, 0.24, 0.22), smooth(0.9, 2.2, damp) * 0.45)
    foot = np.broadcast_to(-0.4 * np.exp(-rise / 0.5), shape)
    return shade(front, foot.astype(np.float32))


def _door(front: Image, left: int, top: int, density: float, random: np.random.Generator) -> None:
    shape = (front.shape[0] - top, int(1.1 * density))
    on = Canvas(shape, random)
    leaf = on.flat(PAINTS[int(random.integers(6))]) * 0.55
    leaf = shade(leaf, 0.12 * on.fractal(coarse=20))
    for row in range(3):
        low, high = int(shape[0] * (0.08 + 0.3 * row)), int(shape[0] * (0.30 + 0.3 * row))
        for start, end in ((0.12, 0.46), (0.54, 0.88)):
            corner = (int(shape[1] * start), low)
            far = (int(shape[1] * end), high)
            cv2.rectangle(leaf, corner, far, (0.12, 0.11, 0.10), 1)
    paste(front, leaf, left, top, border=max(2, int(0.08 * density)))


def _sign(front: Image, density: float, random: np.random.Generator, number: int) -> None:
    paper, ink, _ = INKS[number % len(INKS)]
    bottom = front.shape[0] - int((STOREY - 0.55) * density)
    top = bottom - int(0.62 * density)
    left, right = int(0.12 * front.shape[1]), int(0.88 * front.shape[1])
    front[top:bottom, left:right] = paper
    cv2.rectangle(front, (left, top), (right, bottom), (0.15, 0.14, 0.13), 2)
    word = WORDS[int(random.integers(len(WORDS)))]
    letters(front, word, (left + 12, top + 4, right - 12, bottom - 4), ink, None)
