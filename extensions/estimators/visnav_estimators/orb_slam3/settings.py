"""Files for ORB-SLAM3: settings from announcements, and the vocabulary of visual words.

Settings are in the older of the two forms of ORB-SLAM3 1.0 (the parsers of its ``Tracking.cc``):
only this one lets RGB-D with an IMU initialize without a quick motion. A missing parameter would
end the process. The template is ``settings.yaml.jinja``.

The vocabulary is a tree of binary descriptors, made by k-majority (Grana et al., *A fast approach
for integrating ORB descriptors in the bag of words model*, 2013): k-means with Hamming distance and
majority bits. The file is DBoW2's text format, as in ORB-SLAM3's own ``ORBvoc.txt``: a line ``k L
scoring weighting``, then one line a node after its parent's line, ``parent leaf d0 … d31 weight``,
the root not being written.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo, ImuAnnouncement
from events.geometry import pose_matrix
from nodes.data.dataset.recording import templates
from runtime.run.results import replacing

Mode = Literal[
    "rgbd", "monocular", "stereo", "rgbd_inertial", "monocular_inertial", "stereo_inertial"
]

LENSES: dict[str, frozenset[str]] = {
    "rgbd": frozenset({"plumb_bob"}),
    "monocular": frozenset({"plumb_bob", "equidistant"}),
    "stereo": frozenset(),
}
"""Distortion models supported by ORB-SLAM3, by the mode without IMU.

With depth, key points are pinhole's or plumb_bob's (``Frame::UndistortKeyPoints``,
``Frame::UnprojectStereo``). Stereo partners are looked for in the same row of distorted images
(``Frame::ComputeStereoMatches``).
"""

Positive = Annotated[float, msgspec.Meta(gt=0)]
Threshold = Annotated[int, msgspec.Meta(ge=1, le=255)]


class OrbSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """ORB-SLAM3's own settings, besides the calibration.

    Attributes:
        features: Corners looked for in an image. With depth, the first image with more than 500
            initializes.
        scale_factor: Factor between two levels of the image pyramid.
        levels: Levels of the image pyramid.
        fast_threshold: Grey levels by which a corner differs from its surroundings.
        min_fast_threshold: The same, for regions without corners by `fast_threshold`.
        baseline: Metres between two cameras, assumed for an RGB-D camera. It weighs depth: the
            variance is ``(z² / (baseline fx))²`` square metres per square pixel.
        close_depth: Depth in metres up to which a point enters the map at once; a farther one after
            two views.
        loop_closing: Whether known places correct the map; the node refuses false.
    """

    features: Annotated[int, msgspec.Meta(ge=100, le=10_000)] = 1000
    scale_factor: Annotated[float, msgspec.Meta(gt=1, le=2)] = 1.2
    levels: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    fast_threshold: Threshold = 20
    min_fast_threshold: Threshold = 7
    baseline: Positive = 0.1
    close_depth: Positive = 4.0
    loop_closing: bool = True


class Settings(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Start-up settings of an ORB-SLAM3 process."""

    mode: Mode  # the sensors used
    text: str  # the settings file, as YAML
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy, in pixels
    # The (left) camera in the IMU's frame, shape (4, 4); identity without an IMU.
    camera_on_imu: npt.NDArray[np.float64]


def make_settings(
    mode: Mode,
    cameras: Sequence[CameraAnnouncement],
    imu: ImuAnnouncement | None = None,
    orb: OrbSettings | None = None,
) -> Settings:
    """Return the settings for announced cameras, and an IMU if the mode is inertial.

    Args:
        cameras: The camera, or the left and the right one of a rectified stereo rig.

    Raises:
        ValueError: The IMU is not on the body that carries the camera.
    """
    orb = orb or OrbSettings()
    camera, info = cameras[0], cameras[0].info
    baseline = orb.baseline
    if len(cameras) == 2:  # row by row: see `Estimator.aligned`
        baseline = float((np.linalg.inv(_pose(camera)) @ _pose(cameras[1]))[0, 3])
    on_imu = _on_imu(camera, imu) if imu is not None and "inertial" in mode else np.eye(4)
    environment = templates(Path(__file__).parent)
    environment.filters["real"] = _real
    text = environment.get_template("settings.yaml.jinja").render(
        mode=mode,
        camera=camera,
        lens=_distortion(info),
        imu=imu,
        pose=on_imu.ravel().tolist(),
        orb=orb,
        baseline=baseline,
    )
    return Settings(
        mode=mode,
        text=text,
        width=info.width,
        height=info.height,
        intrinsics=(info.fx, info.fy, info.cx, info.cy),
        camera_on_imu=on_imu,
    )


def _distortion(info: CameraInfo) -> dict[str, float]:
    if info.distortion_model == "equidistant":
        return dict(zip(("k1", "k2", "k3", "k4"), info.distortion, strict=True))
    k1, k2, p1, p2, k3 = info.distortion[:5]
    if any(info.distortion):
        k1 = k1 or 1e-12  # at 0, ORB-SLAM3 takes it that there is no distortion at all
    return {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}


def _pose(sensor: CameraAnnouncement | ImuAnnouncement) -> npt.NDArray[np.float64]:
    return pose_matrix(sensor.position, sensor.orientation)


def _on_imu(camera: CameraAnnouncement, imu: ImuAnnouncement) -> npt.NDArray[np.float64]:
    """Return the camera in the IMU's frame, shape (4, 4)."""
    if imu.parent_frame_id != camera.parent_frame_id:
        raise ValueError(
            f"expected an IMU on {camera.parent_frame_id}, on which {camera.source} is mounted, "
            f"found {imu.source} on {imu.parent_frame_id}"
        )
    pose: npt.NDArray[np.float64] = np.linalg.inv(_pose(imu)) @ _pose(camera)
    return pose


def _real(value: float) -> str:
    """Return a number as a real for OpenCV's YAML reader: with a point."""
    text = f"{value:.9g}"
    mantissa, e, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{e}{exponent}"


Bytes = npt.NDArray[np.uint8]
Integers = npt.NDArray[np.int64]

_BYTES = 32  # bytes of an ORB descriptor
_ITERATIONS = 10  # of moving the centres, at most; later ones change next to nothing
_SCORING, _WEIGHTING = 0, 0  # L1 norm, tf-idf (DBoW2's ScoringType, WeightingType)
_FIELDS = 2 + _BYTES + 1  # numbers on a node's line: parent, leaf or not, descriptor, weight


class TreeShape(msgspec.Struct, frozen=True, kw_only=True):
    """Shape of a vocabulary's tree.

    Attributes:
        branching: Children of a node, at most.
        depth: Levels below the root, at most: up to ``branching ** depth`` words.
        index_level: Level of the nodes by which ORB-SLAM3 sorts features before comparing; 0
            compares all with all, a higher one is quicker and gives fewer matches.
        seed: Seed of the choice of the first centres.
    """

    branching: Annotated[int, msgspec.Meta(ge=2, le=20)] = 10
    depth: Annotated[int, msgspec.Meta(ge=1, le=6)] = 4
    index_level: Annotated[int, msgspec.Meta(ge=0, le=2)] = 1
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0

    def header_depth(self) -> int:
        """L of the file: ORB-SLAM3's index is four levels above it (``transform(…, 4)``)."""
        return max(self.index_level + 4, self.depth)


class Vocabulary(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A tree of visual words; parents come before their children."""

    branching: int  # k of the file
    depth: int  # L of the file
    parents: Integers  # int64 (n,): parent's index; -1 for the root, which is node 0
    leaves: npt.NDArray[np.bool_]  # bool (n,): True for a word
    descriptors: Bytes  # uint8 (n, 32)
    # Float64 (n,): a word's inverse document frequency; 0 for other nodes.
    weights: npt.NDArray[np.float64]


def train(images: Sequence[Bytes], shape: TreeShape | None = None) -> Vocabulary:
    """Make a vocabulary from the descriptors of images.

    Args:
        images: The descriptors of each, uint8 (n, 32).

    Raises:
        ValueError: There are no descriptors, or they are not of ORB's size.
    """
    shape = shape or TreeShape()
    for features in images:
        if features.dtype != np.uint8 or features.ndim != 2 or features.shape[1] != _BYTES:
            raise ValueError(
                f"expected descriptors as uint8 of shape (n, {_BYTES}), "
                f"found {features.dtype} of shape {features.shape}"
            )
    total = sum(len(features) for features in images)
    if total < shape.branching:
        raise ValueError(
            f"expected at least {shape.branching} descriptors to train a vocabulary from, "
            f"found {total} in {len(images)} images"
        )
    descriptors = np.concatenate(images)
    image_of = np.repeat(np.arange(len(images)), [len(features) for features in images])
    parents, centres, node_of = _grow(descriptors, shape)
    leaves = np.ones(len(parents), bool)
    leaves[parents[1:]] = False
    # One more than there are images: a word that all of them show keeps a weight above 0, below
    # which DBoW2 would leave its features out, also of ORB-SLAM3's index for matching.
    shown = np.unique(node_of * len(images) + image_of) // len(images)
    counts = np.bincount(shown, minlength=len(parents))
    weights = np.where(leaves, np.log((len(images) + 1) / np.maximum(counts, 1)), 0.0)
    return Vocabulary(
        branching=shape.branching,
        depth=shape.header_depth(),
        parents=parents,
        leaves=leaves,
        descriptors=centres,
        weights=weights,
    )


def _grow(descriptors: Bytes, shape: TreeShape) -> tuple[Integers, Bytes, Integers]:
    """Split descriptors level by level; return parents (n,), centres (n, 32) and leaves."""
    rng = np.random.default_rng(shape.seed)
    parents, centres = [-1], [np.zeros(_BYTES, np.uint8)]
    leaf_of = np.zeros(len(descriptors), np.int64)
    level = [np.arange(len(descriptors))]
    for _ in range(shape.depth):
        above, level = level, []
        for members in above:
            node = int(leaf_of[members[0]])
            means, cluster = _split(descriptors[members], shape.branching, rng)
            for number, centre in enumerate(means):
                below = members[cluster == number]
                leaf_of[below] = len(parents)
                parents.append(node)
                centres.append(centre)
                # One descriptor, or many alike, cannot be split any further.
                if (descriptors[below] != centre).any():
                    level.append(below)
    return np.array(parents), np.array(centres), leaf_of


def _split(descriptors: Bytes, k: int, rng: np.random.Generator) -> tuple[Bytes, Integers]:
    """Split descriptors into at most k clusters; return centres (n, 32) and memberships."""
    # k-means++ (Arthur & Vassilvitskii 2007).
    centres = descriptors[rng.integers(len(descriptors), size=1)]
    nearest = _distances(descriptors, centres)[:, 0]
    while len(centres) < k and nearest.any():
        share = np.cumsum(nearest**2)
        picked = np.searchsorted(share, rng.integers(share[-1]), "right")
        centres = np.vstack([centres, descriptors[picked]])
        nearest = np.minimum(nearest, _distances(descriptors, centres[-1:])[:, 0])
    bits = np.unpackbits(descriptors, axis=1)
    cluster = _distances(descriptors, centres).argmin(1)
    for _ in range(_ITERATIONS):
        used, cluster = np.unique(cluster, return_inverse=True)
        share = np.array([bits[cluster == number].mean(0) for number in range(len(used))])
        centres = np.packbits(share >= 0.5, axis=1)
        before, cluster = cluster, _distances(descriptors, centres).argmin(1)
        if np.array_equal(before, cluster):
            break
    used, cluster = np.unique(cluster, return_inverse=True)
    return centres[used], cluster


def _distances(descriptors: Bytes, centres: Bytes) -> Integers:
    """Return the Hamming distances of descriptors from centres, shape (n, k)."""
    a, b = (np.ascontiguousarray(array).view(np.uint64) for array in (descriptors, centres))
    distances: Integers = np.bitwise_count(a[:, None] ^ b).sum(-1, dtype=np.int64)
    return distances


def cached_vocabulary(shape: TreeShape) -> Path:
    """Return the path of this shape's vocabulary, below ``$XDG_CACHE_HOME`` or ``~/.cache``."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    key = hashlib.sha256(msgspec.json.encode(shape)).hexdigest()[:12]
    return base / "visnav-runtime" / f"orb-vocabulary-{key}.txt"


def find_vocabulary(setting: str) -> Path:
    """Return a setting's vocabulary, by default the cached one; a `ValueError` if unusable."""
    path = Path(setting).expanduser() if setting else cached_vocabulary(TreeShape())
    if not path.exists():
        raise ValueError(
            f"expected a vocabulary at {path}, found none; to make one from what the cameras of "
            "a configuration see: python -m runtime vocabulary config.toml"
        )
    check_vocabulary(path)
    return path


def write_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Write a file in DBoW2's text format, whole or not at all; its folder is made if missing."""
    header = f"{vocabulary.branching} {vocabulary.depth} {_SCORING} {_WEIGHTING}"
    numbers = np.column_stack([vocabulary.parents, vocabulary.leaves, vocabulary.descriptors])
    lines = (
        f"{' '.join(map(str, row))} {weight:.9g}"
        for row, weight in zip(numbers[1:].tolist(), vocabulary.weights[1:].tolist(), strict=True)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as new:
        # No newline at the end: DBoW2 would read a node from the empty line after it.
        new.write_text("\n".join([header, *lines]), encoding="ascii")


def check_vocabulary(path: Path) -> tuple[int, int]:
    """Check whether a file is in DBoW2's text format, else a `ValueError`; return k and L."""
    try:
        with path.open(encoding="ascii") as lines:
            header, first = lines.readline(), lines.readline()
    except OSError as error:
        raise ValueError(f"{path}: expected a vocabulary file, found: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError(
            f"{path}: expected a vocabulary in DBoW2's text format, found a binary file"
        ) from None
    if path.suffix != ".txt":
        raise ValueError(
            f"{path}: expected a name that ends with .txt (ORB-SLAM3 reads any other as binary)"
        )
    words = header.split()
    if len(words) != 4 or not all(word.isdecimal() for word in words):
        raise ValueError(
            f"{path}: line 1: expected four whole numbers (branching, depth, scoring, weighting), "
            f"found {header.strip()[:60]!r}"
        )
    branching, depth, scoring, weighting = map(int, words)
    if not (2 <= branching <= 20 and 1 <= depth <= 10 and scoring <= 5 and weighting <= 3):
        raise ValueError(
            f"{path}: line 1: expected branching 2 to 20, depth 1 to 10, scoring 0 to 5, "
            f"weighting 0 to 3, found {header.strip()!r}"
        )
    try:
        count = len([float(word) for word in first.split()])
    except ValueError:
        count = 0
    if count != _FIELDS:
        raise ValueError(
            f"{path}: line 2: expected {_FIELDS} numbers (parent, leaf, 32 bytes, weight), "
            f"found {first.strip()[:60]!r}"
        )
    return branching, depth
