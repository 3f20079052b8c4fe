"""Vocabularies read back from their files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nodes.estimators.orb_slam3.vocabulary import Vocabulary, check_vocabulary


def read_vocabulary(path: Path) -> Vocabulary:
    branching, depth = check_vocabulary(path)
    rows = np.loadtxt(path, skiprows=1, ndmin=2)
    table = np.vstack([[-1, 0, *[0] * 32, 0], rows])
    return Vocabulary(
        branching=branching,
        depth=depth,
        parents=table[:, 0].astype(np.int64),
        leaves=table[:, 1].astype(bool),
        descriptors=table[:, 2:-1].astype(np.uint8),
        weights=table[:, -1].copy(),
    )
