"""``RESULTS.md``: what the numbers do not show, then the numbers, by ``page.md.jinja``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import msgspec

from bench.plots import draw
from bench.suite import Results
from bench.tables import TABLES, latency


def write(results: Results, out: Path, page_path: Path) -> None:
    """Write the page of results, its plots, and the figures themselves.

    Args:
        out: Folder for results.json and the plots, made if missing.
        page_path: The page, Markdown.
    """
    out.mkdir(parents=True, exist_ok=True)
    encoded = msgspec.json.format(msgspec.json.encode(results), indent=1)
    (out / "results.json").write_bytes(encoded + b"\n")
    plots = draw(results.rows, out, (2, 128))
    folder = os.path.relpath(out, page_path.parent)
    page_path.write_text(page(results, plots, folder), encoding="utf-8")


def page(results: Results, plots: Mapping[str, Sequence[str]], folder: str) -> str:
    """Return the whole page as Markdown; the plots of each case are in `folder`."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=False,  # noqa: S701  # Markdown is no HTML
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    text = environment.get_template("page.md.jinja").render(
        results=results,
        goals=_goals(results),
        tables=TABLES,
        latency=latency,
        plots=plots,
        folder=folder,
    )
    return text.rstrip() + "\n"


def _goals(results: Results) -> Iterator[tuple[Any, ...]]:
    """Yield what is compared with the marks that the project sets itself: the cells of a row."""
    medians = {(r.case, r.system, r.mode, r.nodes): r.median_us for r in results.rows}
    nodes = sorted({nodes for case, _, _, nodes in medians if case == "small"})
    ros, cpp, queue = "ROS 1 nodelets", "thesis client (C++)", "asyncio.Queue (uvloop)"
    comparisons = [
        (what, peer, n, ("small", "visnav", mode, n), ("small", peer, peer_mode, n), mark)
        for what, mode, peer, peer_mode, counts, mark in (
            ("small, handlers", "handler", "plain calls", "handler", nodes, "≤ 1.3"),
            ("small, streams", "stream", queue, "stream", (2, 16, 128), "≤ 0.33"),
            ("small, handlers", "handler", ros, "handler", (2,), "≤ 0.05"),
            ("small, handlers", "handler", ros, "handler", (128,), "≤ 0.2"),
            ("small, handlers", "handler", "roscpp, one process", "handler", (2, 128), "as it is"),
            ("small, handlers", "handler", cpp, "handler", (2, 16, 64, 128), "as it is"),
            ("small, addressed", "routed", cpp, "handler", (2, 16, 64, 128), "as it is"),
        )
        for n in counts
    ]
    first, last = (("small", "visnav", "routed", n) for n in (nodes[0], nodes[-1]))
    small, shared, copied = (
        (case, "visnav", "handler", 2) for case in ("small", "large-shared", "large")
    )
    plain = ("large", "plain calls", "handler", 2)
    comparisons += [
        ("small, addressed", f"itself at N = {nodes[0]}", nodes[-1], last, first, "≤ 1.2"),
        ("large-shared, handlers", "our small message", 2, shared, small, "≤ 1.1"),
        ("large, handlers", "a copy and a plain call", 2, copied, plain, "≤ 1.1"),
    ]
    for what, beside, n, ours, theirs, mark in comparisons:
        if ours in medians and theirs in medians:
            yield what, beside, n, f"{medians[ours] / medians[theirs]:.2f}", mark
    bursts = next(r for r in results.throughput if "one wake" in r.case)
    yield (
        "burst of 256 events in one wake, each",
        "",
        "",
        f"{bursts.per_event_us:.2f} µs",
        "≤ 0.5 µs",
    )
    late = "p99 lateness of a 400 Hz tick"
    p99 = {row.mode: row.late_p99_us for row in results.stall}
    ratio = f"{p99['worker'] / p99['none']:.2f}"
    yield f"{late}, camera in a worker", "no camera", "", ratio, "≤ 1.25"
    percent = results.idle.cpu_percent
    yield "processor time of a 100 Hz timer", "one core", "", f"{percent:.2f} %", "≤ 1 %"
    for b in results.bridge:
        mark = "≤ 2" if b.bytes < 1000 else "≤ 1.3"
        yield f"{b.case} to another process and back", "Zenoh", 2, f"{b.ratio:.2f}", mark
    for row in results.recording[1:]:
        yield f"{late}, {row.case}", "no recorder", "", f"{row.ratio_p99:.2f}", "≤ 1.25"
    for flood in results.flood[1:]:
        what = f"{late}, {flood.messages_per_second:,.0f} messages a second"
        yield what, "quiet", "", f"{flood.ratio_p99:.2f}", "≤ 1.5"
    for asked in results.airsim[1:]:
        what = f"{late}, AirSim's client asks for {asked.case}"
        yield what, "quiet", "", f"{asked.ratio_p99:.2f}", "≤ 1.25"
