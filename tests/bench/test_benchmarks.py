"""The table of benchmarks: what it names is there, and its commands take what it lists."""

from __future__ import annotations

import importlib
import inspect

import pytest

from bench.benchmarks import BENCHMARKS, SECTIONS, Benchmark, Column


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda benchmark: str(benchmark.name))
def test_a_benchmark_measures_with_its_options(benchmark: Benchmark) -> None:
    module, _, function = benchmark.measure.partition(":")
    measure = getattr(importlib.import_module(f"bench.{module}"), function)
    taken = inspect.signature(measure).parameters.keys()
    assert {"progress", *(option.name for option in benchmark.options)} <= taken


def test_each_benchmark_has_a_command_and_a_section() -> None:
    names = {benchmark.name for benchmark in BENCHMARKS}
    assert len(names) == len(BENCHMARKS)
    for benchmark in BENCHMARKS:
        assert benchmark.help or benchmark.command in names
        assert benchmark.section in SECTIONS or benchmark.name == "idle"


def test_options_have_values_of_their_own_in_a_run_of_all() -> None:
    (stall,) = (benchmark for benchmark in BENCHMARKS if benchmark.name == "stall")
    values = {option.name: option for option in stall.options}
    assert [values["repeats"].in_all(quick=quick) for quick in (False, True)] == [5, 2]
    assert values["rate"].in_all(quick=True) == values["rate"].default


def test_cells_are_written_by_their_specification() -> None:
    row = {"us": 12.34, "slow": 1234.5, "bytes": 5e6, "none": None, "zero": 0}
    specs = {"us": "us", "slow": "us", "bytes": "?MB", "none": ".1f", "zero": "?.1f", "no": ""}
    cells = [Column("", key, spec).cell(row) for key, spec in specs.items()]
    assert cells == ["12.3", "1234", "5", "", "", ""]
