"""Comparison paired over flights, with an interval and a verdict in words.

Both sides get the same recorded flights, so the difference of a pair has no part in how hard its
flight was. The test is Wilcoxon's signed-rank test (F. Wilcoxon, Individual comparisons by ranking
methods, 1945), exact, ties included, by the distribution under random signs; the interval is that
of Hodges and Lehmann's estimate (pseudo-median of the differences), by inverting the test. Ranks
know of "worst": a run that crashed, or an estimator without the figure, loses its pair by more than
any other pair differs, and is never left out.

A figure that is positive in all pairs is compared by its ratio, in percent, others by their
difference. Of several figures or estimators each gets its share of the error (Bonferroni), and so
does each look where flights are added until the answer is sure: half of it the first, a quarter the
second, and so on, so that all looks ever made have no more than the whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from runtime.errors import ConfigError
from runtime.figures import figure

if TYPE_CHECKING:
    from runtime.tools.sweep import Row

Floats = npt.NDArray[np.float64]
Key = tuple[str, int]  # flight of a pair: scenario and seed

USUAL = ("flight_ate_percent", "rpe_1m_trans_percent", "rot_rmse_deg", "frame_coverage_percent")
"""Figures compared by default: errors with lost time as drift, drift, rotation, coverage."""

ERROR = 0.05
"""Share of comparisons without a difference in which one may be found, of all figures together."""

Word = Literal["better", "worse", "identical", "no difference", "not enough runs", "not comparable"]


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Comparison of a figure of an estimator.

    Attributes:
        a: Median over the flights, of those with the figure.
        change: Pseudo-median of B less A: percent if `relative`, else in the figure's unit;
            infinite if most pairs were lost by a failure.
        low: Lower end of the interval for it.
        p: Share of random signs with a result as extreme.
        failures: Flights without the figure, in A and in B.
        verdict: "not comparable" for an error after different alignments in A and B; "identical" if
            no flight has different values, and no margin says whether that is enough.
        more: Flights that would probably tell, for a verdict of "not enough runs" or "identical".
        missing: Side without the estimator in any run, ``A`` or ``B``; what is missing is worse.
        alignments: The different alignments of a pair, if "not comparable".
        flights: Values of A and B by scenario and seed; `None` where there is none.
    """

    estimator: str
    figure: str
    a: float | None
    b: float | None
    change: float
    low: float
    high: float
    relative: bool
    p: float
    pairs: int
    failures: tuple[int, int]
    verdict: Word
    more: int = 0
    alignments: tuple[str, ...] = ()
    missing: Literal["", "A", "B"] = ""
    flights: dict[str, tuple[float | None, float | None]] = {}

    @property
    def unit(self) -> str:
        """Unit of the change and its interval."""
        return "%" if self.relative else figure(self.figure).unit

    @property
    def words(self) -> str:
        """Verdict in words: "not enough runs: 5 more may tell"."""
        if self.missing:
            return f"{self.verdict}: not there in {self.missing}"
        if self.verdict == "identical" and self.more:
            return f"identical so far: {self.more} more may tell"
        if self.verdict == "no difference" and all(a == b for a, b in self.flights.values()):
            return "no difference: identical"
        if self.verdict == "not enough runs":
            return f"not enough runs: {self.more} more may tell"
        if self.verdict == "not comparable":
            return f"not comparable: after {' and '.join(self.alignments)}"
        return self.verdict

    @property
    def medians(self) -> list[str]:
        """Medians of A and of B, with flights without the figure: ``0.31 m (2 failed)``."""
        unit = figure(self.figure).unit
        return [
            ("–" if value is None else f"{value:.4g} {unit}") + f" ({lost} failed)" * bool(lost)
            for value, lost in zip((self.a, self.b), self.failures, strict=True)
        ]

    @property
    def interval(self) -> str:
        """Change with its interval: ``+12 % (+4.1 to +21)``."""
        values = (self.change, self.low, self.high)
        change, low, high = (f"{value:+.3g}".replace("inf", "∞") for value in values)
        return f"{change} {self.unit} ({low} to {high})"

    def by_scenario(self) -> dict[str, tuple[int, int, int]]:
        """Return the flights of each scenario: where B is worse, where it is better, and all."""
        sign = -1.0 if figure(self.figure).limit == "least" else 1.0
        counts: dict[str, tuple[int, int, int]] = {}
        for name, pair in self.flights.items():
            a, b = (math.inf if value is None else sign * value for value in pair)
            worse, better, flights = counts.get(scenario := name.rpartition(",")[0], (0, 0, 0))
            counts[scenario] = worse + (b > a), better + (b < a), flights + 1
        return counts

    def inferior(self, margin: float) -> bool:
        """Return whether B may be worse than A by more than a margin."""
        if self.verdict == "not comparable" or self.missing:
            return self.missing != "A"
        if figure(self.figure).limit == "least":
            return bool(self.low < -margin)
        return bool(self.high > margin)

    def fails(self, margin: float) -> bool:
        """Return whether B is worse, or with a margin was not shown to be no worse than that."""
        return self.inferior(margin) if margin else self.verdict == "worse"


def compare_values(
    estimator: str,
    name: str,
    pairs: Mapping[Key, tuple[float | None, float | None]],
    *,
    margin: float = 0.0,
    error: float = ERROR,
) -> Comparison:
    """Compare a figure over flights.

    Args:
        pairs: Values of A and B by flight; `None` for a failure, which is worse than any value.
        error: Probability of a difference found where there is none.
    """
    sign = -1.0 if figure(name).limit == "least" else 1.0  # of a change for the worse
    complete = [(a, b) for a, b in pairs.values() if a is not None and b is not None]
    relative = bool(complete) and all(a > 0 and b > 0 for a, b in complete)
    changes = np.array([math.log(b / a) if relative else b - a for a, b in complete])
    # Farther than any average of two differences: the sign of a failure's pair is all that counts.
    worst = 1e3 * (abs(changes).max(initial=0.0) + 1.0)
    lost = [(a is None, b is None) for a, b in pairs.values() if a is None or b is None]
    differences = np.concatenate([changes, [sign * worst * (int(b) - int(a)) for a, b in lost]])
    p, change, low, high = signed_rank(differences, error)

    def to_change(value: float) -> float:
        if abs(value) > worst / 4:
            return math.copysign(math.inf, value)
        return 100.0 * math.expm1(value) if relative else value

    change, low, high = to_change(change), to_change(low), to_change(high)
    verdict: Word = "not enough runs"
    more = 0
    if margin > 0 and -margin <= low and high <= margin:
        verdict = "no difference"
    elif complete and not lost and all(a == b for a, b in complete):
        verdict, more = "identical", max(_least(error) - len(complete), 0)
    elif p <= error and (low > 0 or high < 0):
        verdict = "worse" if (low > 0) == (sign > 0) else "better"
    else:
        more = _more(len(differences), change, low, high, margin, error)
    medians = np.median(complete, axis=0).tolist() if complete else (None, None)
    return Comparison(
        estimator=estimator, figure=name, a=medians[0], b=medians[1], change=change, low=low,
        high=high, relative=relative, p=p, pairs=len(pairs),
        failures=(sum(a for a, _ in lost), sum(b for _, b in lost)), verdict=verdict, more=more,
        flights={f"{scenario}, seed {seed}": pair for (scenario, seed), pair in pairs.items()},
    )  # fmt: skip


def signed_rank(differences: Floats, error: float) -> tuple[float, float, float, float]:
    """Return p-value, pseudo-median and the ends of its interval (1 - error).

    The ends are infinite where there are too few differences for any. Differences of 0 are ranked,
    and count for neither side (Pratt, 1959).
    """
    from scipy.stats import rankdata

    n = len(differences)
    if not n:
        return 1.0, 0.0, -math.inf, math.inf
    ranks = np.round(2 * rankdata(abs(differences))).astype(int)
    signed = ranks[differences != 0]
    sums = _sums(signed)
    rank_sum = int(ranks[differences > 0].sum())
    p = min(2 * min(sums[: rank_sum + 1].sum(), sums[rank_sum:].sum()), 1.0)
    averages = np.sort(
        ((differences[:, None] + differences) / 2)[np.triu_indices(n)], kind="stable"
    )
    # Averages beyond the interval at each end: of the plain ranks, which no ties can spoil.
    tail = np.cumsum(_sums(np.arange(1, n + 1)))
    tail_count = int(np.searchsorted(tail, error / 2, side="right"))
    change = float(np.median(averages))
    if not tail_count:
        return float(p), change, -math.inf, math.inf
    return float(p), change, float(averages[tail_count - 1]), float(averages[-tail_count])


def _sums(ranks: npt.NDArray[np.int_]) -> Floats:
    """Return the probability of each sum of ranks, each taken or not with probability 1/2."""
    sums = np.zeros(int(ranks.sum()) + 1)
    sums[0] = 1.0
    for rank in ranks.tolist():
        sums[rank:] = (sums[rank:] + sums[: len(sums) - rank]) / 2
        sums[:rank] /= 2
    return sums


def _more(n: int, change: float, low: float, high: float, margin: float, error: float) -> int:
    """Return how many more flights probably decide: intervals shrink as 1 / √n."""
    least = _least(error)
    if not all(map(math.isfinite, (change, low, high))):
        return max(least - n, 1)
    half = (high - low) / 2
    goals = [goal for goal in (abs(change), margin - abs(change)) if goal > 0]
    needed = n * (half / max(goals)) ** 2 if goals else math.inf
    return max(least - n, math.ceil(min(needed, 1e4)) - n, 1)


def _least(error: float) -> int:
    return math.ceil(math.log2(2 / error))


def compare_until_sure(
    compare: Callable[[int, float], list[Comparison]], most: int, looked: list[int]
) -> list[Comparison]:
    """Compare with half of the flights, and with all if not every figure is decided then.

    The k-th look, also one of an earlier call, has 1/2^k of the error; a look with too few flights
    to find anything, whatever they show, is none. (Bonferroni over a number of looks that nobody
    knows beforehand; the shares of group-sequential designs ask for that number.)

    Args:
        compare: Compares so many flights, with so much error.
        looked: Numbers of flights that were looked at earlier; extended.
    """
    half = math.ceil(most / 2)
    looks = {half, most} if half in looked or half > max(looked, default=0) else {most}
    rows: list[Comparison] = []
    for flights in sorted(looks):
        number = looked.index(flights) if flights in looked else len(looked)
        error = ERROR / 2 ** (number + 1)
        rows = compare(flights, error)
        if flights not in looked and max(row.pairs for row in rows) >= _least(error / len(rows)):
            looked.append(flights)
        # What is identical in half of the flights may still differ in the others.
        if all(row.verdict not in {"not enough runs", "identical"} for row in rows):
            break
    return rows


def compare_rows(
    a: Mapping[Key, Sequence[Row]],
    b: Mapping[Key, Sequence[Row]],
    *,
    figures: Sequence[str] = USUAL,
    margin: float = 0.0,
    error: float = ERROR,
) -> list[Comparison]:
    """Compare runs, paired by flight; repeats of a flight are averaged.

    An estimator that only one side has is a row of its own: whoever lacks it is worse.

    Raises:
        ConfigError: They have no flight, no estimator or no figure in common.
    """
    common = [key for key in a if key in b]
    if not common:
        raise ConfigError(
            "compare: expected runs of the same scenarios and seeds, found none in common: "
            f"{_some(a)}; {_some(b)}"
        )
    names_a, names_b = ([*_estimators(side.values())] for side in (a, b))
    names = [(name, name) for name in names_a if name in names_b]
    if not names and len(names_a) == len(names_b) == 1:  # two systems of different names
        names = [(names_a[0], names_b[0])]
    if not names and bool(names_a) == bool(names_b):
        raise ConfigError(f"compare: expected an estimator in both, found {names_a} and {names_b}")
    compared = [
        (name, other, metric)
        for name, other in names
        for metric in figures
        if any(_value(a[k], name, metric) is not None for k in common)
        or any(_value(b[k], other, metric) is not None for k in common)
    ]
    paired = {name for pair in names for name in pair}
    alone = [
        *(_alone(name, "B", a, common, figures) for name in names_a if name not in paired),
        *(_alone(name, "A", b, common, figures) for name in names_b if name not in paired),
    ]
    if not compared and not alone:
        raise ConfigError(f"compare: expected {', '.join(figures)}, found none of them in any run")
    comparisons = []
    for name, other, metric in compared:
        pairs = {
            key: (_value(a[key], name, metric), _value(b[key], other, metric)) for key in common
        }
        label = name if name == other else f"{name} / {other}"
        comparison = compare_values(
            label, metric, pairs, margin=margin, error=error / len(compared)
        )
        alignments = [(_alignments(a[key], name), _alignments(b[key], other)) for key in common]
        differing = sorted({text for x, y in alignments if x and y and x != y for text in x | y})
        if differing and figure(metric).after_alignment:
            comparison = msgspec.structs.replace(
                comparison, verdict="not comparable", more=0, alignments=tuple(differing)
            )
        comparisons.append(comparison)
    return comparisons + alone


def _alone(
    name: str,
    missing: Literal["A", "B"],
    runs: Mapping[Key, Sequence[Row]],
    common: Sequence[Key],
    figures: Sequence[str],
) -> Comparison:
    """Return the row of an estimator that one side does not have, with a figure of the other."""
    by_figure = {f: [_value(runs[key], name, f) for key in common] for f in figures}
    metric = next((f for f, v in by_figure.items() if any(x is not None for x in v)), figures[0])
    values = by_figure[metric]
    numbers = [value for value in values if value is not None]
    median = float(np.median(numbers)) if numbers else None
    sign = -1.0 if figure(metric).limit == "least" else 1.0
    change = sign * (math.inf if missing == "B" else -math.inf)
    lost, all_ = len(values) - len(numbers), len(values)
    return Comparison(
        estimator=name, figure=metric, change=change, low=change, high=change, relative=False,
        p=1.0, pairs=all_, missing=missing, verdict="worse" if missing == "B" else "better",
        a=None if missing == "A" else median, b=None if missing == "B" else median,
        failures=(all_, lost) if missing == "A" else (lost, all_),
        flights={
            f"{scenario}, seed {seed}": (None, value) if missing == "A" else (value, None)
            for (scenario, seed), value in zip(common, values, strict=True)
        },
    )  # fmt: skip


def _alignments(rows: Sequence[Row], estimator: str) -> set[str]:
    verdicts = (row["estimators"].get(estimator, {}) for row in rows)
    return {str(verdict["alignment"]) for verdict in verdicts if verdict.get("alignment")}


def _some(side: Mapping[Key, object]) -> str:
    return ", ".join(f"{scenario} {seed}" for scenario, seed in [*side][:3]) or "none"


def _estimators(sides: Iterable[Sequence[Row]]) -> dict[str, None]:
    return {name: None for rows in sides for row in rows for name in row["estimators"]}


def _value(rows: Sequence[Row], estimator: str, name: str) -> float | None:
    values = [
        None if row["error"] else row["estimators"].get(estimator, {}).get(name) for row in rows
    ]
    if not values or any(value is None for value in values):
        return None
    return float(np.mean([float(value) for value in values if value is not None]))
