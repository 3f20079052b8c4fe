"""What images look like to a feature detector: ``python -m runtime.tools.reality.images FOLDER …``.

For comparing the simulator's rooms with photographs of real ones, taken by the same lens::

    folder       images  corners 20  corners 7  empty cells %  mean  contrast  gradient
    hall/data        87        2065       7363            0.0   114        34       3.4
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

CELL = 40
"""Side of a cell (pixels)."""

COLUMNS = "corners 20", "corners 7", "empty cells %", "mean", "contrast", "gradient"
HEADER = f"{'folder':38}{'images':>8}  {'  '.join(COLUMNS)}"


class ImageFigures(NamedTuple):
    """Figures of a grey image, or their medians over several."""

    strong_corners: float  # FAST corners of threshold 20
    corners: float  # FAST corners of threshold 7
    empty_cells: float  # share of the cells of 40 x 40 pixels without any of the latter (%)
    mean: float  # of the grey levels
    contrast: float  # standard deviation of the grey levels
    gradient: float  # median of its length (grey levels per pixel)


def figures_of(image: npt.NDArray[np.uint8]) -> ImageFigures:
    """Return the figures of a grey image, shape (height, width)."""
    strong, corners = (
        cv2.FastFeatureDetector.create(threshold).detect(image) for threshold in (20, 7)
    )
    rows, columns = (size // CELL for size in image.shape)
    cells = {(int(at.pt[1]) // CELL, int(at.pt[0]) // CELL) for at in corners}
    occupied = sum(row < rows and column < columns for row, column in cells)
    along_x, along_y = (cv2.Sobel(image, cv2.CV_32F, x, 1 - x) / 8.0 for x in (1, 0))
    return ImageFigures(
        strong_corners=len(strong),
        corners=len(corners),
        empty_cells=100.0 * (1.0 - occupied / (rows * columns)),
        mean=float(image.mean()),
        contrast=float(image.std()),
        gradient=float(np.median(np.hypot(along_x, along_y))),
    )


def medians(paths: Iterable[Path]) -> ImageFigures:
    """Return the medians over images in files.

    Raises:
        ValueError: A file is no image.
    """
    rows = []
    for path in paths:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f"{path}: expected an image, found something else")
        rows.append(figures_of(image.astype(np.uint8, copy=False)))
    return ImageFigures(*np.median(rows, axis=0).tolist())


def main(folders: list[str]) -> int:
    """Print a row for each folder of PNG images; return 2 if one has none."""
    print(HEADER)
    for folder in folders:
        paths = sorted(Path(folder).glob("*.png"))
        if not paths:
            print(f"{folder}: expected a folder with PNG images, found none", file=sys.stderr)
            return 2
        row = medians(paths)
        print(
            f"{folder:38}{len(paths):8}{row.strong_corners:12.0f}{row.corners:11.0f}"
            f"{row.empty_cells:15.1f}{row.mean:6.0f}{row.contrast:10.0f}{row.gradient:10.1f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
