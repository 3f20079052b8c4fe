"""``bench``: handed over to the package `bench`, which is found by name, as nodes are."""

from __future__ import annotations

import importlib

import typer


def bench(context: typer.Context) -> None:
    """Measure latency and throughput: bench --help lists the benchmarks."""
    app = importlib.import_module("bench.cli").app
    app(args=context.args, prog_name="python -m runtime bench", standalone_mode=True)
