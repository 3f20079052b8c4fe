"""Measurements in processes of their own: which are made, and what they are summed up to."""

from __future__ import annotations

import subprocess
from typing import Any

import numpy as np
import pytest

from bench import driver
from bench.driver import find, measure_all
from bench.ours import measure
from bench.system import Case, Mode, Samples, System


@pytest.mark.parametrize("mode", ["handler", "stream", "routed"])
@pytest.mark.parametrize("nodes", [2, 5])
def test_our_nodes_exchange_pings(mode: Mode, nodes: int) -> None:
    """Every mode gives as many samples as asked for, all of them times."""
    samples = measure(Case(mode=mode, nodes=nodes, samples=50, warm_up=5))
    assert samples.shape == (50,)
    assert (samples > 0).all()


@pytest.mark.slow
def test_a_measurement_has_a_process_of_its_own() -> None:
    case = Case(samples=20, warm_up=2)
    samples = driver._measure("bench.systems.in_process", "plain calls", case)
    assert samples.shape == (20,)
    assert (samples > 0).all()


def test_a_row_sums_up_the_samples_of_all_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rounds of one system at two numbers of nodes: two rows, with both rounds' medians."""
    monkeypatch.setattr(driver, "_measure", lambda *which: find(*which[:2]).measure(which[2]))
    outcome = measure_all(
        "small", nodes=(2, 3), samples=60, warm_up=5, repeats=2, only=("plain calls",)
    )
    assert [(r["system"], r["nodes"], r["samples"]) for r in outcome.rows] == [
        ("plain calls", 2, 120),
        ("plain calls", 3, 120),
    ]
    for row in outcome.rows:
        assert (
            0 < row["q1_us"] <= row["median_us"] <= row["q3_us"] <= row["p99_us"] <= row["max_us"]
        )
        assert len(row["rounds_us"]) == 2
    assert outcome.missing == {}


def _system(name: str, **options: Any) -> System:
    def none(case: Case) -> Samples:
        return np.ones(case.samples, np.int64)

    return System(name=name, modes=("handler",), measure=none, **options)


def test_what_cannot_be_measured_is_named_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system that is not installed, and one that fails, are no rows but reasons."""
    absent = _system("absent", missing=lambda: "pip install absent")
    monkeypatch.setattr(driver, "systems", lambda: {"no.such.module": [absent, _system("broken")]})
    outcome = measure_all("small", nodes=(2,), samples=30, warm_up=0, repeats=1)
    assert outcome.rows == []
    assert outcome.missing["absent"] == "pip install absent"
    assert "No module named 'no'" in outcome.missing["broken, handler, 2 nodes"]


def test_a_system_is_not_measured_beyond_its_largest_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """`max_nodes` and the cases that a system has limit what is asked of it."""
    asked: list[tuple[str, int]] = []

    def note(module: str, name: str, case: Case) -> Samples:
        asked.append((name, case.nodes))
        return np.arange(1, case.samples + 1, dtype=np.int64)

    few = _system("few", max_nodes=4)
    small = _system("small only", cases=("small",))
    monkeypatch.setattr(driver, "systems", lambda: {"m": [few, small]})
    monkeypatch.setattr(driver, "_measure", note)
    measure_all("small", nodes=(2, 8), samples=30, warm_up=0, repeats=1)
    assert sorted(asked) == [("few", 2), ("small only", 2), ("small only", 8)]
    asked.clear()
    measure_all("large", nodes=(2,), samples=30, warm_up=0, repeats=1)
    assert asked == [("few", 2)]


def test_slow_systems_make_fewer_round_trips() -> None:
    """The budget of seconds limits the samples, but never below 30."""
    slow = _system("slow", slowness=1000.0)
    assert driver._affordable(20_000, slow, "small", 2, budget=1.0) == 1000
    assert driver._affordable(20_000, slow, "small", 128, budget=1.0) == 30
    assert driver._affordable(20_000, _system("quick"), "small", 2, budget=1.0) == 20_000


def test_an_unknown_system_is_said_to_be_unknown() -> None:
    """The process that measures ends with the names that it knows."""
    with pytest.raises(LookupError, match=r"expected one of .*plain calls.*, found .plane calls."):
        find("bench.systems.in_process", "plane calls")


def test_the_last_line_of_a_failure_is_its_reason() -> None:
    """A process that failed is described by what it said last, one that hung by the limit."""
    failed = subprocess.CalledProcessError(1, [], stderr=b"Traceback\nOSError: no route\n")
    assert driver._reason(failed) == "OSError: no route"
    assert "no result within" in driver._reason(subprocess.TimeoutExpired([], 1.0))
