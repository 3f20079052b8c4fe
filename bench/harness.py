"""Paired runs: sides measured in turns, programs beside them, and the figures that compare sides.

Sides take turns in each round's own random order, so that a busy minute of the machine falls on all
alike; a ratio is that of two medians, or the median of the ratios of pairs.
"""

from __future__ import annotations

import contextlib
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from bench.benchmarks import Progress

T = TypeVar("T")
S = TypeVar("S", bound=str)


def silent(*_: object) -> None:
    """Progress that nobody is told."""


def in_turns(sides: Iterable[T], rounds: int) -> Iterator[tuple[int, T]]:
    """Yield the number of a round and a side, for all sides in each round's own random order."""
    order, shuffle = [*sides], random.Random(0).shuffle
    for number in range(rounds):
        shuffle(order)
        for side in order:
            yield number, side


def paired(
    sides: Mapping[S, Callable[[], T]], rounds: int, progress: Progress = silent
) -> dict[S, list[T]]:
    """Measure each side once a round, and return what the measurements gave, by side."""
    taken: dict[S, list[T]] = {side: [] for side in sides}
    for number, side in in_turns(sides, rounds):
        progress(f"round {number + 1} of {rounds}: {side}")
        taken[side].append(sides[side]())
    return taken


def timed(do: Callable[[], object]) -> int:
    """Return how long a call takes, nanoseconds."""
    begin = time.perf_counter_ns()
    do()
    return time.perf_counter_ns() - begin


def pair(taken: Mapping[str, Sequence[int]]) -> dict[str, float]:
    """Return the figures of a row to compare two sides: times (ns) by the prefix of their names.

    Medians and 99th percentiles are in microseconds; `ratio` is that of the two medians.
    """
    figures: dict[str, float] = {}
    for side, times in taken.items():
        middle, high = np.percentile(times, (50, 99)) / 1e3
        figures |= {f"{side}_us": float(middle), f"{side}_p99_us": float(high)}
    ours, theirs = (figures[f"{side}_us"] for side in taken)
    return {**figures, "ratio": ours / theirs}


@contextlib.contextmanager
def program(
    *words: object, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Run ``python WORDS…`` beside the block, with pipes for text; end it afterwards."""
    with subprocess.Popen(
        [sys.executable, *map(str, words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **(environment or {})},
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def lines_of(process: subprocess.Popen[Any]) -> Iterator[str]:
    """Yield the lines that a program prints, as they come."""
    assert process.stdout is not None
    yield from process.stdout
