"""Wind: gusts of the shape 1 - cos, and turbulence with the spectrum of MIL-F-8785C."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.units import Duration
from sims.worlds.dynamics import FOOT, Gust, Turbulence, WindSpec, scales, turned


def spectrum(axis: int, omega: float, speed: float, height: float, w20: float) -> float:
    """Return the standard's one-sided power spectrum, (m/s)² per rad/s, whose integral is sigma².

    Args:
        axis: 0 along the mean wind, 1 across, 2 vertical.
        omega: Angular frequency, rad/s.
        speed: Through the air, m/s.
        height: Above the ground, metres.
        w20: Wind at a height of 20 feet, m/s.
    """
    sigma, length = (pair[axis] for pair in scales(height, w20))
    x = (length * omega / speed) ** 2
    if axis == 0:
        return 2 * sigma**2 * length / (math.pi * speed) / (1 + x)
    return sigma**2 * length / (math.pi * speed) * (1 + 3 * x) / (1 + x) ** 2


def series(
    seconds: float, step: float, *, speed: float = 8.0, height: float = 50.0, w20: float = 15.4
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return what a vehicle feels along, across and vertical, shape (n, 3)."""
    random = np.random.default_rng(5)
    air = Turbulence(random.standard_normal(Turbulence.NUMBERS).tolist())
    noise = random.standard_normal((round(seconds / step), Turbulence.NUMBERS)).tolist()
    return np.array([air.step(step, speed, height, w20, numbers) for numbers in noise])


def test_intensities_and_lengths_are_those_of_the_standard() -> None:
    """At 200 feet, moderate (30 knots), by hand from MIL-F-8785C, figure 10 and its formulae."""
    (u, v, w), (lu, lv, lw) = scales(200 * FOOT, 30 * 0.514444)
    shape = 0.177 + 0.000823 * 200
    assert w == pytest.approx(1.5433, abs=1e-3)
    assert u == v == pytest.approx(1.5433 / shape**0.4, abs=1e-3)
    assert lw == pytest.approx(200 * FOOT)
    assert lu == lv == pytest.approx(200 / shape**1.2 * FOOT)
    assert scales(0.5, 10.0) == scales(10 * FOOT, 10.0)  # the model ends at 10 and 1000 feet
    assert scales(5000.0, 10.0) == scales(1000 * FOOT, 10.0)
    (u, _, w), (lu, _, lw) = scales(1000 * FOOT, 10.0)
    assert u == pytest.approx(w)  # where it meets the medium-altitude model
    assert lu == pytest.approx(lw)


@pytest.mark.slow
def test_the_spectrum_is_that_of_the_formula() -> None:
    """In each octave, from half the corner frequency to 16 times it."""
    from scipy.signal import welch

    step, speed, height, w20 = 0.02, 40.0, 50.0, 15.4
    felt = series(6000.0, step, speed=speed)
    for axis in range(3):
        hertz, density = welch(felt[:, axis], 1 / step, nperseg=2**14, detrend=False)
        corner = speed / scales(height, w20)[1][axis] / math.tau
        for centre in corner * 2.0 ** np.arange(-1.0, 4.1):
            band = (hertz > centre * 2**-0.5) & (hertz < centre * 2**0.5)
            expected = [
                math.tau * spectrum(axis, math.tau * f, speed, height, w20) for f in hertz[band]
            ]
            assert density[band].mean() == pytest.approx(np.mean(expected), rel=0.25), centre
        assert felt[:, axis].std() == pytest.approx(scales(height, w20)[0][axis], rel=0.05)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_integral_of_the_spectrum_is_the_variance(axis: int) -> None:
    omega = np.geomspace(1e-6, 1e5, 20001)
    density = [spectrum(axis, frequency, 8.0, 50.0, 15.4) for frequency in omega]
    assert np.trapezoid(density, omega) == pytest.approx(scales(50.0, 15.4)[0][axis] ** 2, rel=2e-3)


@settings(max_examples=15, deadline=None)
@given(step=st.floats(1e-3, 2.0), speed=st.floats(0.0, 40.0), height=st.floats(0.0, 500.0))
def test_it_is_as_strong_at_any_step_speed_and_height(
    step: float, speed: float, height: float
) -> None:
    """The discretisation is exact: of many places of the air, the deviation stays what it is."""
    random = np.random.default_rng(1)
    ends = []
    for _ in range(200):
        air = Turbulence(random.standard_normal(Turbulence.NUMBERS).tolist())
        for numbers in random.standard_normal((8, Turbulence.NUMBERS)).tolist():
            felt = air.step(step, speed, height, 10.0, numbers)
        ends.append(felt)
    expected = scales(height, 10.0)[0]
    assert np.std(ends, axis=0) == pytest.approx(expected, rel=0.25)


@pytest.mark.slow
def test_ten_small_steps_are_as_one_large_one() -> None:
    """Their correlations in time agree, whatever the step."""
    fine, coarse = series(2000.0, 0.05, speed=20.0)[::10], series(10000.0, 0.5, speed=20.0)
    for axis in range(3):
        for lag in (1, 4, 10):
            one, other = (
                np.corrcoef(felt[:-lag, axis], felt[lag:, axis])[0, 1] for felt in (fine, coarse)
            )
            assert one == pytest.approx(other, abs=0.08), (axis, lag)


@given(seconds=st.floats(-5.0, 60.0), hold=st.floats(0.0, 3.0), rise=st.floats(0.1, 3.0))
def test_a_gust_rises_holds_falls_and_comes_again(seconds: float, hold: float, rise: float) -> None:
    gust = Gust(
        velocity=(1.0, 0.0, 0.0),
        start=Duration(2.0),
        rise=Duration(rise),
        hold=Duration(hold),
        period=Duration(10.0),
    )
    share = gust.share(seconds)
    assert 0.0 <= share <= 1.0
    if seconds <= 2.0:
        assert share == 0.0
    else:
        assert gust.share(seconds + 10.0) == pytest.approx(share, abs=1e-6)
    assert gust.share(2.0 + rise + hold / 2) == pytest.approx(1.0)
    assert gust.share(2.0 + rise / 2) == pytest.approx(0.5)


def test_a_gust_that_comes_once_is_over_after_it() -> None:
    gust = Gust(velocity=(1.0, 0.0, 0.0), rise=Duration(1.0))
    assert [gust.share(t) for t in (0.0, 1.0, 2.0, 50.0)] == pytest.approx([0, 1, 0, 0], abs=1e-12)
    with pytest.raises(ValueError, match=r"period: expected at least the 2 s .* found 1 s"):
        Gust(velocity=(1.0, 0.0, 0.0), rise=Duration(1.0), period=Duration(1.0))


def test_turbulence_is_along_and_across_the_mean_wind() -> None:
    assert turned((1.0, 0.0, 0.5), (0.0, 3.0, 0.0)) == pytest.approx((0.0, 1.0, 0.5))
    assert turned((0.0, 1.0, 0.0), (0.0, 3.0, 0.0)) == pytest.approx((-1.0, 0.0, 0.0))
    assert turned((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)) == (1.0, 2.0, 3.0)


def test_strengths_have_names() -> None:
    assert WindSpec(turbulence="light").w20 == pytest.approx(7.717, abs=1e-3)
    assert WindSpec(turbulence=3.5).w20 == 3.5
    assert WindSpec().still
    assert not WindSpec(velocity=(0.0, 0.1, 0.0)).still
