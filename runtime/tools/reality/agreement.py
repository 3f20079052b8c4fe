"""Agreement of simulated errors with published ones: rankings, levels, failures.

Pure functions of numbers. Errors are metres; an infinite one is a failure. ``simulated`` has them
by system and cell, a sequence in a world, ``published`` by system and sequence. Only what is in
both is compared.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Cell(NamedTuple):
    """A sequence in a world."""

    sequence: str
    world: str


Simulated = Mapping[str, Mapping[Cell, float]]
Published = Mapping[str, Mapping[str, float]]

ENOUGH = 6  # systems, for a verdict on a ranking: with four, perfect agreement has p = 0.04 at best
LEAST_SYSTEMS = 3  # for a ranking at all
LEAST_RANKINGS = 3  # of so many systems, for a verdict on their median
LEAST_SEQUENCES = 3  # of a system, for its own median, by which a failure is known
FAILED = 5.0  # times that median
APART = 2.0  # ratio in reality of a pair of which the order should be right
NEAR = 0.3, 3.3  # worst ratios of one system in two papers
MOST_PERMUTED = 8  # systems of which all orders are looked at

Verdict = Literal[
    "passed", "failed", "not enough systems", "not enough sequences", "nothing to compare"
]


class Criterion(msgspec.Struct, frozen=True, kw_only=True):
    """A criterion with its figure.

    Attributes:
        figure: In words; empty if there is none.
        passes: What passes, in words.
        ceiling: The figure between real data sets, or between two papers; empty if unknown.
    """

    name: str
    figure: str
    passes: str
    ceiling: str
    verdict: Verdict


class Ranking(msgspec.Struct, frozen=True, kw_only=True):
    """Ranking of the systems in a cell.

    Attributes:
        p: Share of all orders that agree with the published one as well or better.
    """

    cell: Cell
    systems: int
    spearman: float
    p: float | None


def ranks(values: Iterable[float]) -> Floats:
    """Return ranks from 1; equal values, also infinite ones, share the mean of theirs."""
    from scipy.stats import rankdata  # here, as its import takes half a second

    return np.asarray(rankdata([*values]), np.float64)


def spearman(a: Iterable[float], b: Iterable[float]) -> float:
    """Return Spearman's coefficient; NaN if all values of a side are equal."""
    return _correlation(ranks(a), ranks(b))


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = math.sqrt(float((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / scale if scale else math.nan


def exact_p(a: Sequence[float], b: Sequence[float]) -> float | None:
    """Return the share of all orders of `b` whose Spearman's coefficient is as high or higher.

    `None` for more than 8 values, or if all values of a side are equal.
    """
    ranks_a, ranks_b = ranks(a), ranks(b)
    actual = _correlation(ranks_a, ranks_b)
    if len(ranks_a) > MOST_PERMUTED or math.isnan(actual):
        return None
    sums = ranks_b[_orders(len(ranks_a))] @ ranks_a
    return float((sums >= float(ranks_a @ ranks_b) - 1e-9).mean())


@functools.cache
def _orders(size: int) -> npt.NDArray[np.int64]:
    return np.array([*itertools.permutations(range(size))])


def rankings(simulated: Simulated, published: Published) -> list[Ranking]:
    """Return the ranking of each cell with at least three systems."""
    result = []
    for cell in _cells(simulated):
        names = [
            name
            for name in simulated
            if cell in simulated[name] and cell.sequence in published.get(name, {})
        ]
        if len(names) < LEAST_SYSTEMS:
            continue
        sim = [simulated[name][cell] for name in names]
        real = [published[name][cell.sequence] for name in names]
        coefficient = spearman(sim, real)
        if not math.isnan(coefficient):
            ranking = Ranking(
                cell=cell, systems=len(names), spearman=coefficient, p=exact_p(real, sim)
            )
            result.append(ranking)
    return result


class Inversion(msgspec.Struct, frozen=True, kw_only=True):
    """A pair whose order is wrong: in reality the first errs less, by `real` times."""

    better: str
    worse: str
    real: float  # error of the worse divided by that of the better, median over the cells
    sim: float


def inversions(simulated: Simulated, published: Published) -> tuple[list[Inversion], int]:
    """Return the pairs far apart in reality whose order is wrong, and how many are far apart.

    A pair is compared by the medians over all cells of the ratio of its errors.
    """
    wrong, far = [], 0
    for a, b in itertools.permutations(simulated, 2):
        ratios = [
            (published[b][c.sequence] / published[a][c.sequence], _ratio(simulated, b, a, c))
            for c in simulated[a]
            if c in simulated[b] and _finite_pair(published, a, b, c.sequence)
        ]
        ratios = [pair for pair in ratios if not math.isnan(pair[1])]
        if not ratios:
            continue
        real, sim = (float(np.median(values)) for values in zip(*ratios, strict=True))
        if real > APART:
            far += 1
            if sim < 1.0:
                wrong.append(Inversion(better=a, worse=b, real=real, sim=sim))
    return wrong, far


def _finite_pair(published: Published, a: str, b: str, sequence: str) -> bool:
    errors = [published.get(name, {}).get(sequence, math.inf) for name in (a, b)]
    return all(map(math.isfinite, errors))


def _ratio(simulated: Simulated, over: str, under: str, cell: Cell) -> float:
    above, below = simulated[over][cell], simulated[under][cell]
    if math.isinf(above) and math.isinf(below):
        return math.nan
    return math.inf if below == 0.0 else above / below


def levels(simulated: Simulated, published: Published) -> dict[tuple[str, Cell], float]:
    """Return simulated divided by published errors, where both are known and none failed."""
    return {
        (name, cell): error / published[name][cell.sequence]
        for name, cells in simulated.items()
        for cell, error in cells.items()
        if math.isfinite(error)
        and math.isfinite(published.get(name, {}).get(cell.sequence, math.inf))
    }


def failing(errors: Mapping[str, float]) -> dict[str, bool]:
    """Return in which sequences a system fails: none, or more than 5 times its own median.

    With fewer than three sequences, whose median has no meaning, only where there is none.
    """
    enough = len(errors) >= LEAST_SEQUENCES
    limit = FAILED * float(np.median([*errors.values()])) if enough else math.inf
    return {name: math.isinf(error) or error > limit for name, error in errors.items()}


def failing_cells(errors: Mapping[Cell, float]) -> dict[Cell, bool]:
    """Return in which cells a system fails, by its own median in each world."""
    result: dict[Cell, bool] = {}
    for world in dict.fromkeys(cell.world for cell in errors):
        by_sequence = {cell.sequence: e for cell, e in errors.items() if cell.world == world}
        result |= {Cell(name, world): failed for name, failed in failing(by_sequence).items()}
    return result


class Failures(msgspec.Struct, frozen=True, kw_only=True):
    """How often systems fail in the simulation (sim), in reality (real), in both."""

    both: int
    sim_only: int
    real_only: int
    neither: int

    @property
    def recall(self) -> float:
        """Share of the published failures that fail; NaN if there are none."""
        return _share(self.both, self.both + self.real_only)

    @property
    def precision(self) -> float:
        """Share of the failures that are published; NaN if there are none."""
        return _share(self.both, self.both + self.sim_only)

    @property
    def false(self) -> float:
        """Share of what does not fail in reality that fails; NaN if there is nothing."""
        return _share(self.sim_only, self.sim_only + self.neither)


def _share(part: int, total: int) -> float:
    return part / total if total else math.nan


def failures(simulated: Simulated, published: Published) -> Failures:
    """Count failures by system and cell; each side's are known by its own medians."""
    counts = {(sim, real): 0 for sim in (True, False) for real in (True, False)}
    for name, cells in simulated.items():
        real = failing(published.get(name, {}))
        for cell, failed in failing_cells(cells).items():
            if cell.sequence in real:
                counts[failed, real[cell.sequence]] += 1
    return Failures(
        both=counts[True, True],
        sim_only=counts[True, False],
        real_only=counts[False, True],
        neither=counts[False, False],
    )


def difficulty(simulated: Simulated, published: Published) -> dict[str, float]:
    """Return by system how its sequences rank by difficulty, as Spearman's coefficient."""
    result = {}
    for name, cells in simulated.items():
        for world in dict.fromkeys(cell.world for cell in cells):
            pairs = [
                (error, published[name][cell.sequence])
                for cell, error in cells.items()
                if cell.world == world and cell.sequence in published.get(name, {})
            ]
            if len(pairs) >= LEAST_SEQUENCES:
                coefficient = spearman(*zip(*pairs, strict=True))
                if not math.isnan(coefficient):
                    result[f"{name}, {world}"] = coefficient
    return result


def ablation(
    condition: Mapping[str, Mapping[Hashable, float]],
    against: Mapping[str, Mapping[Hashable, float]],
) -> dict[str, tuple[float, int]]:
    """Return by system the median error under a condition divided by that under another.

    Over the runs that both have; with their number. Without a finite one, a system is left out.
    """
    result = {}
    for name, errors in condition.items():
        runs = [run for run in errors if run in against.get(name, {})]
        if not runs:
            continue
        above = float(np.median([errors[run] for run in runs]))
        below = float(np.median([against[name][run] for run in runs]))
        if math.isfinite(above) and math.isfinite(below) and below > 0.0:
            result[name] = above / below, len(runs)
    return result


def criteria(simulated: Simulated, published: Published) -> list[Criterion]:
    """Return all criteria with their figures and verdicts."""
    several = rankings(simulated, published)
    full = [ranking for ranking in several if ranking.systems >= ENOUGH]
    shown = full or several
    middle = float(np.median([r.spearman for r in shown])) if shown else math.nan
    wrong, far = inversions(simulated, published)
    ratios = [*levels(simulated, published).values()]
    level = float(np.median(ratios)) if ratios else math.nan
    inside = float(np.mean([NEAR[0] <= r <= NEAR[1] for r in ratios])) if ratios else math.nan
    failed = failures(simulated, published)
    hard = [*difficulty(simulated, published).values()]
    systems = sum(1 for name in simulated if published.get(name))
    return [
        Criterion(
            name="ranking of systems",
            figure=_ranking_figure(middle, shown, len(several)) if shown else "",
            passes=f"≥ 0.7 over at least {LEAST_RANKINGS} rankings of at least {ENOUGH} systems",
            ceiling="0.82 (nine stereo systems in EuRoC's machine hall against its Vicon rooms)",
            verdict="not enough sequences"
            if 0 < len(full) < LEAST_RANKINGS
            else _verdict(middle >= 0.7, enough=bool(full)),
        ),
        Criterion(
            name="pairs in the right order",
            figure=f"{len(wrong)} of {far} pairs that are {APART:g} × apart in reality are inverted"
            if far
            else "",
            passes=f"none inverted, of at least {ENOUGH} systems in all",
            ceiling="",
            verdict=_verdict(not wrong, enough=systems >= ENOUGH, there=far > 0),
        ),
        Criterion(
            name="level",
            figure=f"{level:.3g} in the median of {len(ratios)}" if ratios else "",
            passes="simulated / published 0.5 to 2",
            ceiling="1.3 between two papers",
            verdict=_verdict(0.5 <= level <= 2.0, there=bool(ratios)),
        ),
        Criterion(
            name="level, each system and sequence",
            figure=f"{inside:.0%} of {len(ratios)} within {NEAR[0]} to {NEAR[1]}" if ratios else "",
            passes="≥ 80 %",
            ceiling="100 % between two papers, 3.3 at worst",
            verdict=_verdict(inside >= 0.8, there=bool(ratios)),
        ),
        Criterion(
            name="published failures fail",
            figure=_counted(failed.both, failed.both + failed.real_only),
            passes="≥ 80 %",
            ceiling="",
            verdict=_verdict(failed.recall >= 0.8, there=not math.isnan(failed.recall)),
        ),
        Criterion(
            name="false failures",
            figure=_counted(failed.sim_only, failed.sim_only + failed.neither),
            passes="≤ 10 %",
            ceiling="",
            verdict=_verdict(failed.false <= 0.1, there=not math.isnan(failed.false)),
        ),
        Criterion(
            name="difficulty of sequences (reported only)",
            figure=f"Spearman {np.median(hard):.2f}, median of {len(hard)}" if hard else "",
            passes="",
            ceiling="0.46 (between two systems)",
            verdict="nothing to compare",
        ),
    ]


def _ranking_figure(middle: float, shown: Sequence[Ranking], total: int) -> str:
    sizes = [ranking.systems for ranking in shown]
    span = " to ".join(map(str, dict.fromkeys((min(sizes), max(sizes)))))
    text = f"Spearman {middle:.2f}, median of {len(shown)} rankings of {span} systems"
    smaller = total - len(shown)
    return text + f" ({smaller} of fewer left out)" * bool(smaller)


def _counted(part: int, total: int) -> str:
    return f"{part} of {total}" if total else ""


def _verdict(right: bool, *, enough: bool = True, there: bool = True) -> Verdict:
    if not there:
        return "nothing to compare"
    if not enough:
        return "not enough systems"
    return "passed" if right else "failed"


def _cells(simulated: Simulated) -> list[Cell]:
    return sorted({cell for cells in simulated.values() for cell in cells})
