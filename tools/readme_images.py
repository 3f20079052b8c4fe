"""Make the README's images from the results of `make demo`."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2

PLOTS, DOCS = Path("runs/tour/plots"), Path("docs/images")


def main() -> None:
    """Copy the report's images."""
    features = cv2.imread(str(PLOTS / "frames_odometry.png"))
    if features is None:
        raise SystemExit(f"expected {PLOTS / 'frames_odometry.png'}: run `make demo` first")
    cv2.imwrite(str(DOCS / "features.jpg"), features, [cv2.IMWRITE_JPEG_QUALITY, 85])
    shutil.copy(PLOTS / "trajectories.png", DOCS / "trajectories.png")


if __name__ == "__main__":
    main()
