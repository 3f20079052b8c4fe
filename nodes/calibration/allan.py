"""Proof 2: Allan deviation of a stationary IMU, compared with the announced noise.

IEEE Std 952-1997, annex C: σ²(τ) = N²/τ of white noise with the density N, K²τ/3 of a random walk
with the density K. Both are fitted at once, to the overlapping estimates of all axes; the fit's
tolerance comes from as many samples made of the announced numbers.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from events import ImuAnnouncement
from nodes.calibration.proofs import Figure, judged

Floats = npt.NDArray[np.float64]

ALLOWED = 0.10  # permitted relative difference between measured and announced density
_TRIALS = 24


class Curve(msgspec.Struct, frozen=True, eq=False):
    """Allan deviation of a sensor, measured and as announced; arrays have the shape (n,)."""

    name: str
    seconds: Floats
    measured: Floats
    announced: Floats


def variances(
    samples: Floats,  # at equal intervals, shape (n, axes)
    rate: float,  # hertz
) -> tuple[Floats, Floats]:
    """Return averaging times (s) and overlapping Allan variances, mean of all axes."""
    sums = np.vstack([np.zeros(samples.shape[1]), np.cumsum(samples - samples.mean(0), axis=0)])
    steps = np.unique(np.geomspace(1, len(samples) // 6, 22).astype(int))
    found = [((sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]) / m).var() / 2.0 for m in steps]
    return steps / rate, np.array(found)


def densities(seconds: Floats, found: Floats, white: float, walk: float) -> tuple[float, float]:
    """Return N and K fitted to Allan variances, weighted by the announced densities."""
    terms = np.column_stack([1.0 / seconds, seconds / 3.0])
    spread = (terms @ [max(white, 1e-15) ** 2, walk**2]) * np.sqrt(seconds)
    n2, k2 = nnls(terms / spread[:, None], found / spread)[0]
    return float(np.sqrt(n2)), float(np.sqrt(k2))


def trials(
    white: float, walk: float, step: float, rate: float, count: int, seed: int = 7
) -> Floats:
    """Return N and K fitted to simulated samples of given densities, shape (n, 2)."""
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(_TRIALS):
        samples = np.cumsum(generator.standard_normal((count, 3)) * walk / rate**0.5, axis=0)
        samples += generator.standard_normal((count, 3)) * white * rate**0.5
        if step:
            samples = np.rint(samples / step) * step
        found.append(densities(*variances(samples, rate), white, walk))
    return np.array(found)


def needed(imu: ImuAnnouncement, most: float) -> float:
    """Return how long an IMU has to stand for its numbers to be shown, seconds, at most `most`."""
    seconds = 60.0
    for name in ("gyroscope", "accelerometer"):
        numbers = _announced(imu, name)
        found = trials(*numbers, imu.rate, round(60.0 * imu.rate))
        for value, spread in zip(numbers, found.std(axis=0), strict=False):
            if value:
                seconds = max(seconds, 60.0 * (2.5 * spread / value / ALLOWED) ** 2)
    return min(seconds, most)


def noise(imu: ImuAnnouncement, samples: dict[str, Floats]) -> Iterator[tuple[Curve, list[Figure]]]:
    """Yield curve and figures of each sensor; its samples at rest have the shape (n, 3)."""
    for name, rows in samples.items():
        white, walk, step = _announced(imu, name)
        seconds, found = variances(rows, imu.rate)
        fitted = densities(seconds, found, white, walk)
        tried = trials(white, walk, step, imu.rate, len(rows))
        model = np.sqrt(white**2 / seconds + walk**2 * seconds / 3.0)
        names = f"{name}_noise_density", f"{name}_random_walk"
        figures = [
            _figure(imu, *each, len(rows) / imu.rate)
            for each in zip(names, (white, walk), fitted, tried.T, strict=True)
        ]
        yield Curve(name, seconds, np.sqrt(found), model), figures


def _announced(imu: ImuAnnouncement, name: str) -> tuple[float, float, float]:
    return tuple(
        float(getattr(imu, f"{name}_{kind}"))
        for kind in ("noise_density", "random_walk", "resolution")
    )  # type: ignore[return-value]


def _figure(
    imu: ImuAnnouncement,
    name: str,
    announced: float,
    value: float,
    expected: Floats,
    seconds: float,
) -> Figure:
    if announced == 0.0:
        limit = 1.5 * float(expected.max()) + 1e-9
        wrong = f"{imu.source}: {name} is {value:.3g}, announced as 0"
        return judged(imu.source, f"{name} where 0 is announced", value, limit, "", wrong)
    middle, spread = float(np.median(expected)), float(expected.std()) / announced
    off = abs(value / middle - 1.0) if middle else float("inf")
    limit, remark = ALLOWED, ""
    if 2.0 * spread > ALLOWED:
        limit = max(4.0 * spread, ALLOWED)
        remark = (
            f"{imu.source}: {seconds:.0f} s show {name} to ±{200 * spread:.0f} % only; "
            f"10 % would take some {seconds * (2.0 * spread / ALLOWED) ** 2:.0f} s"
        )
    if off > limit:
        measured = announced * value / middle if middle else value
        remark = (
            f"{imu.source}: {name} is {measured:.3g} by its Allan deviation, "
            f"announced {announced:.3g}"
        )
    return Figure(imu.source, f"{name} beside {announced:.3g}", off, limit, "of it", remark)
