"""Paths in pieces."""

from __future__ import annotations

import itertools

from nodes.viewers.common import GAP, SPAN, PathPieces

MS = 1_000_000


def test_pieces_join_and_hold_each_pose_once() -> None:
    path = PathPieces()
    poses = [(i * 0.02, 0.0, 0.0) for i in range(200)]
    pieces = [piece for i, p in enumerate(poses) if (piece := path.add(i * 5 * MS, p))]
    pieces.append(path.rest() or [])
    assert len(pieces) == 200 * 5 * MS // SPAN + (200 * 5 * MS % SPAN > 0)
    for before, after in itertools.pairwise(pieces):
        assert before[-1] == after[0]
    assert pieces[0] + [p for piece in pieces[1:] for p in piece[1:]] == poses


def test_a_vehicle_that_stands_adds_nothing() -> None:
    path = PathPieces()
    assert [path.add(i * 50 * MS, (1.0, 1.0, 0.001 * (i % 2))) for i in range(100)] == [None] * 100
    assert path.rest() is None


def test_a_gap_is_not_bridged() -> None:
    path = PathPieces()
    path.add(0, (0.0, 0.0, 0.0))
    path.add(5 * MS, (1.0, 0.0, 0.0))
    assert path.add(6 * MS + GAP, (9.0, 0.0, 0.0)) == [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]
    path.add(7 * MS + GAP, (10.0, 0.0, 0.0))
    assert path.rest() == [(9.0, 0.0, 0.0), (10.0, 0.0, 0.0)]
