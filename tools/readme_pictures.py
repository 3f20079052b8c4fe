"""Make the README's pictures from the results of `make demo`."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2

RUN, DOCS = Path("runs/tour"), Path("docs")


def main() -> None:
    """Shrink what the run left."""
    sheet = cv2.imread(str(RUN / "pictures.png"))
    if sheet is None:
        raise SystemExit(f"expected {RUN / 'pictures.png'}, found none: run `make demo` first")
    small = cv2.resize(sheet, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(DOCS / "pictures.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 88])
    shutil.copy(RUN / "flight.png", DOCS / "flight.png")


if __name__ == "__main__":
    main()
