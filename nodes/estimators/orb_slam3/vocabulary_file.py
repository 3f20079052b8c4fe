"""Vocabularies as files: DBoW2's text format, checks, and the folder of our own ones."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import msgspec
import numpy as np

from nodes.estimators.orb_slam3.vocabulary import TreeShape, Vocabulary
from runtime.run.results import replacing

_SCORING, _WEIGHTING = 0, 0
"""L1 norm and tf-idf, which ORB-SLAM3 expects (DBoW2's ScoringType and WeightingType)."""

_FIELDS = 2 + 32 + 1
"""Numbers on a node's line: parent, leaf or not, descriptor, weight."""


def cached_vocabulary(shape: TreeShape, cache_dir: Path | None = None) -> Path:
    """Return the path of the vocabulary of this shape, whether it exists or not.

    Args:
        shape: Shape of its tree, on which the file's name depends.
        cache_dir: ``$XDG_CACHE_HOME``, or ``~/.cache``, if not given.
    """
    base = cache_dir or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    key = hashlib.sha256(msgspec.json.encode(shape)).hexdigest()[:12]
    return base / "visnav-runtime" / f"orb-vocabulary-{key}.txt"


def find_vocabulary(setting: str) -> Path:
    """Return the vocabulary that a node's setting names: a file, or, if empty, the cached one.

    Raises:
        ValueError: There is none, or it is not in DBoW2's text format.
    """
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
    """Check quickly whether a file can be a vocabulary.

    ORB-SLAM3 ends its process, or reads nonsense, if it is not.

    Returns:
        Branching and depth.

    Raises:
        ValueError: It is missing, or its beginning is not in DBoW2's text format.
    """
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
    _numbers(path, 2, first)
    return branching, depth


def _numbers(path: Path, number: int, line: str) -> list[float]:
    """Return the numbers of a node's line."""
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != _FIELDS:
        raise ValueError(
            f"{path}: line {number}: expected {_FIELDS} numbers (parent, leaf, 32 bytes, weight), "
            f"found {line.strip()[:60]!r}"
        )
    return row
