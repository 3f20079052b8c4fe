"""``RESULTS.md``: what the numbers do not show, then the numbers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from bench.driver import Row
from bench.plots import draw
from bench.suite import Results
from bench.tables import TABLES, latency

CAVEATS = """\
# Results

Made by `make bench`; do not edit.

## What these numbers do not show

- **Latency inside one process is not what a rig mostly waits for.** An estimator that takes 15 ms
  a frame hides every microsecond below. What counts more is that nothing waits for it: see the
  table of stalls.
- **Systems differ in what they do for their time.** ROS, Zenoh, DDS and their like cross processes
  and machines, serialise, discover and survive each other's crashes; a function call does none of
  it. Rows of one process and of several are in tables of their own.
- **Ours are measured without a fingerprint of the events**, as real-time runs are. In lockstep
  each event is hashed, too: rows named *fingerprinted*.
- **Synchronous delivery has a price:** `send` returns when all receivers have run. A slow handler
  is slow for its sender.
- **C++ in one process is out of reach** of anything in Python but delivery to one addressed
  receiver among many.
- **The machine is small, shared and noisy.** Compare rows of one table; they were measured
  interleaved, in one run. Do not compare absolute times with other machines'.
- Pings never overlap, so nothing here is about throughput under load, except the table of that
  name. The first round trips of each process are left out: start-up costs do not show.
"""


def write(results: Results, out: Path, page_path: Path) -> None:
    """Write the page of results, its plots, and the figures themselves.

    Args:
        results: What was measured.
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
    sections = [
        _goals(results),
        _section(results, "Stalls", "stall"),
        _section(
            results,
            "Simulated time",
            "lockstep",
            "parts",
            before="1 kHz physics, 400 Hz control, 200 Hz IMU; a camera of 512×512 RGB-D at 30 Hz.",
        ),
        _section(results, "Throughput", "throughput"),
        _section(
            results,
            "Between processes, and beside the loop",
            *("bridge", "link", "ros_images", "recording", "flood"),
            before="Each of these tables is a run of its own, whose sides were measured in turns.",
        ),
    ]
    for case, title in (
        ("small", "Small message"),
        ("large", "Large message (4.67 MB), copied"),
        ("large-shared", "Large message, by reference or shared memory"),
    ):
        sections.append(_latency(results.rows, case, title, plots.get(case, ()), folder))
    sections.append(_measured(results))
    return "\n".join([CAVEATS, *("\n".join(each) for each in sections)]).rstrip() + "\n"


def _median(rows: Iterable[Row], case: str, system: str, mode: str, nodes: int) -> float | None:
    for r in rows:
        if (r.case, r.system, r.mode, r.nodes) == (case, system, mode, nodes):
            return r.median_us
    return None


def _goals(results: Results) -> Iterator[str]:
    """Compare with the marks that the project sets itself, as ratios of medians."""
    rows = results.rows
    yield "## In short\n"
    yield "Ratios of medians of this run.\n"
    yield "| what | beside | N | ratio | mark |"
    yield "|---|---|--:|--:|--:|"
    nodes = sorted({r.nodes for r in rows if r.case == "small"})
    ros, cpp = "ROS 1 nodelets", "thesis client (C++)"
    comparisons = [
        ("small, handlers", "handler", "plain calls", "handler", nodes, "≤ 1.3"),
        ("small, streams", "stream", "asyncio.Queue (uvloop)", "stream", (2, 16, 128), "≤ 0.33"),
        ("small, handlers", "handler", ros, "handler", (2,), "≤ 0.05"),
        ("small, handlers", "handler", ros, "handler", (128,), "≤ 0.2"),
        ("small, handlers", "handler", "roscpp, one process", "handler", (2, 128), "as it is"),
        ("small, handlers", "handler", cpp, "handler", (2, 16, 64, 128), "as it is"),
        ("small, addressed", "routed", cpp, "handler", (2, 16, 64, 128), "as it is"),
    ]
    for what, mode, peer, peer_mode, counts, mark in comparisons:
        for n in counts:
            ours = _median(rows, "small", "visnav", mode, n)
            theirs = _median(rows, "small", peer, peer_mode, n)
            if ours and theirs:
                yield f"| {what} | {peer} | {n} | {ours / theirs:.2f} | {mark} |"
    first = _median(rows, "small", "visnav", "routed", nodes[0])
    last = _median(rows, "small", "visnav", "routed", nodes[-1])
    if first and last:
        itself = f"itself at N = {nodes[0]}"
        yield f"| small, addressed | {itself} | {nodes[-1]} | {last / first:.2f} | ≤ 1.2 |"
    for case, peer, mark in (("large-shared", "small", "≤ 1.1"), ("large", "plain calls", "≤ 1.1")):
        ours = _median(rows, case, "visnav", "handler", 2)
        theirs = (
            _median(rows, "small", "visnav", "handler", 2)
            if peer == "small"
            else _median(rows, "large", "plain calls", "handler", 2)
        )
        if ours and theirs:
            name = "our small message" if peer == "small" else "a copy and a plain call"
            yield f"| {case}, handlers | {name} | 2 | {ours / theirs:.2f} | {mark} |"
    by_mode = {row.mode: row for row in results.stall}
    bursts = next(r for r in results.throughput if "one wake" in r.case)
    yield f"| burst of 256 events in one wake, each | | | {bursts.per_event_us:.2f} µs | ≤ 0.5 µs |"
    ratio = by_mode["worker"].late_p99_us / by_mode["none"].late_p99_us
    lateness = "p99 lateness of a 400 Hz tick, camera in a worker"
    yield f"| {lateness} | no camera | | {ratio:.2f} | ≤ 1.25 |"
    percent = results.idle.cpu_percent
    yield f"| processor time of a 100 Hz timer | one core | | {percent:.2f} % | ≤ 1 % |"
    for b in results.bridge:
        mark = "≤ 2" if b.bytes < 1000 else "≤ 1.3"
        yield f"| {b.case} to another process and back | Zenoh | 2 | {b.ratio:.2f} | {mark} |"
    for recorded in results.recording[1:]:
        late = f"{lateness.partition(',')[0]}, {recorded.case}"
        yield f"| {late} | no recorder | | {recorded.ratio_p99:.2f} | ≤ 1.25 |"
    for flooded in results.flood[1:]:
        late = f"{lateness.partition(',')[0]}, {flooded.messages_per_second:,.0f} messages a second"
        yield f"| {late} | quiet | | {flooded.ratio_p99:.2f} | ≤ 1.5 |"
    yield ""


def _section(results: Results, title: str, *names: str, before: str = "") -> Iterator[str]:
    """Yield a heading and the tables of what was measured, each under its own title."""
    yield f"## {title}\n"
    if before:
        yield f"{before}\n"
    for name in names:
        if rows := getattr(results, name):
            if TABLES[name].title != title:
                yield f"{TABLES[name].title}:\n"
            yield from TABLES[name].markdown(rows)


def _latency(
    rows: Sequence[Row], case: str, title: str, plots: Sequence[str], folder: str
) -> Iterator[str]:
    yield f"## {title}: median round trip, µs\n"
    for place, where in (("one process", "one process"), ("processes", "processes of their own")):
        own = [r for r in rows if r.case == case and r.place == place]
        if own:
            yield f"Nodes in {where}:\n"
            table, cells = latency(own)
            yield from table.markdown(cells)
    for plot in plots:
        yield f"![{plot.removesuffix('.png')}]({folder}/{plot})\n"


def _measured(results: Results) -> Iterator[str]:
    yield "## Measured with\n"
    for key, value in results.environment.items():
        yield f"- {key}: {value}"
    for system, version in results.versions.items():
        if version and not system.startswith("visnav"):
            yield f"- {system}: {version}"
    if results.missing:
        yield "\nNot measured:\n"
        for system, reason in results.missing.items():
            yield f"- {system}: {reason}"
    yield ""
