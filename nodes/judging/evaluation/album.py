"""Sample images, with the features of estimators in them, spread evenly over a run."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from events import Image, TrackedFeatures
from runtime.source_files import source_file
from runtime.time.clock import SECOND

_WAITING = 30  # images whose features may still come
_RECENT_GREEN, _OUTLIER_RED = (90, 255, 60), (60, 70, 255)  # blue, green, red


class Album:
    """Collection of about `size` images of each estimator, or untracked camera, of a run."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._images: dict[tuple[str, int], Image] = {}  # by optical frame and stamp
        self._tracked: set[str] = set()  # optical frames
        self._samples: dict[str, list[tuple[Image, TrackedFeatures | None]]] = {}
        self._interval: dict[str, int] = {}
        self._next: dict[str, int] = {}

    def add_image(self, image: Image) -> None:
        """Hold an image for its features; keep some images of untracked cameras."""
        if not self._size:
            return
        self._images[image.frame_id, image.stamp] = image
        if len(self._images) > _WAITING:
            del self._images[next(iter(self._images))]
        if image.frame_id not in self._tracked:
            self._keep(image.source, image, None)

    def add_features(self, features: TrackedFeatures) -> None:
        """Keep the image of these features, if the interval since the last has passed."""
        self._tracked.add(features.frame_id)
        image = self._images.get((features.frame_id, features.stamp))
        if image is not None:
            self._keep(features.source, image, features)

    def _keep(self, name: str, image: Image, features: TrackedFeatures | None) -> None:
        if image.stamp < self._next.get(name, 0):
            return
        samples = self._samples.setdefault(name, [])
        interval = self._interval.setdefault(name, SECOND)
        samples.append((image, features))
        if len(samples) > self._size:
            self._samples[name] = samples[::2]
            self._interval[name] = interval = 2 * interval
        self._next[name] = image.stamp + interval

    def write(self, folder: Path) -> None:
        """Draw the kept images into JPEG files: ``<estimator or camera>_<stamp>.jpg``."""
        for name, samples in self._samples.items():
            for image, features in samples:
                if features is None and image.frame_id in self._tracked:
                    continue  # kept before its estimator began
                folder.mkdir(exist_ok=True)
                drawn = draw_features(image, features)
                path = folder / f"{source_file(name)}_{image.stamp:015d}.jpg"
                jpeg = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
                path.write_bytes(jpeg.tobytes())


def draw_features(image: Image, features: TrackedFeatures | None) -> np.ndarray:
    """Return the image (blue, green, red) with a ring on each feature: green, or red if odd."""
    code = cv2.COLOR_GRAY2BGR if image.data.ndim == 2 else cv2.COLOR_RGB2BGR
    canvas = cv2.cvtColor(image.data, code)
    radius = max(round(image.data.shape[1] / 170), 2)
    if features is None:
        return np.asarray(canvas)
    for (x, y), agrees in zip(features.points.tolist(), features.inliers.tolist(), strict=True):
        color = _RECENT_GREEN if agrees else _OUTLIER_RED
        cv2.circle(canvas, (round(x), round(y)), radius, color, 1, cv2.LINE_AA)
    return np.asarray(canvas)
