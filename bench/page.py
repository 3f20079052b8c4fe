"""``RESULTS.md``: what the numbers do not show, then the numbers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from bench.driver import Row
from bench.plots import plot_boxes, plot_scaling
from bench.suite import Results
from bench.tables import number

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
    plots = _plots(results.rows, out)
    folder = os.path.relpath(out, page_path.parent)
    page_path.write_text(page(results, plots, folder), encoding="utf-8")


def page(results: Results, plots: Mapping[str, Sequence[str]], folder: str) -> str:
    """Return the whole page as Markdown; the plots of each case are in `folder`."""
    parts = [CAVEATS, "\n".join(_goals(results)), "\n".join(_stall(results))]
    parts += ["\n".join(_lockstep(results)), "\n".join(_throughput(results))]
    if results.bridge:
        parts.append("\n".join(_beside(results)))
    for case, title in (
        ("small", "Small message"),
        ("large", "Large message (4.67 MB), copied"),
        ("large-shared", "Large message, by reference or shared memory"),
    ):
        parts.append("\n".join(_latency(results.rows, case, title, plots.get(case, ()), folder)))
    parts.append("\n".join(_measured(results)))
    return "\n".join(parts).rstrip() + "\n"


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


def _stall(results: Results) -> Iterator[str]:
    yield "## Stalls: lateness of a 400 Hz tick while a 512×512 RGB-D camera runs at 10 Hz\n"
    columns = ("camera", "late p50 µs", "p99 µs", "max µs", "between ticks: mean ms", "median")
    yield f"| {' | '.join((*columns, 'sd', 'missed', 'fetch ms'))} |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    for r in results.stall:
        fetch = f"{r.fetch_ms_median:.1f}" if r.frames else ""
        yield (
            f"| {r.mode} | {r.late_p50_us:.0f} | {r.late_p99_us:.0f} | {r.late_max_us:.0f} "
            f"| {r.update_mean_ms:.2f} | {r.update_median_ms:.2f} | {r.update_sd_ms:.2f} "
            f"| {r.missed} | {fetch} |"
        )
    yield ""


def _lockstep(results: Results) -> Iterator[str]:
    yield "## Simulated time\n"
    yield "1 kHz physics, 400 Hz control, 200 Hz IMU; the camera is 512×512 RGB-D at 30 Hz.\n"
    yield "| case | simulated seconds a second | the runtime's own share of the time |"
    yield "|---|--:|--:|"
    for r in results.lockstep:
        share = "" if r.share is None else f"{r.share:.0%}"
        yield f"| {r.case} | {r.speed:.1f} | {share} |"
    yield ""
    if results.parts:
        yield "Processor time of a frame (all processes; RGB-D with noise, odometry, evaluation):\n"
        yield "| part | ms | share |\n|---|--:|--:|"
        yield from (f"| {p.part} | {p.ms:.1f} | {p.share:.0%} |" for p in results.parts)
        yield ""


def _throughput(results: Results) -> Iterator[str]:
    yield "## Throughput\n"
    yield "| what | at once | µs each | a second | MB a second |"
    yield "|---|--:|--:|--:|--:|"
    for r in results.throughput:
        size = f"{r.bytes_per_second / 1e6:,.0f}" if r.bytes_per_second else ""
        yield (
            f"| {r.case} | {r.batch} | {number(r.per_event_us)} "
            f"| {r.events_per_second:,.0f} | {size} |"
        )
    yield ""


def _beside(results: Results) -> Iterator[str]:
    yield "## Between processes, and beside the loop\n"
    yield "Each of these tables is a run of its own, whose sides were measured in turns.\n"
    yield "A run in two processes on one machine, beside bare Zenoh sessions in the same two:\n"
    yield "| event | bytes | round trip µs | Zenoh's | ratio | a second | Zenoh's |"
    yield "|---|--:|--:|--:|--:|--:|--:|"
    for b in results.bridge:
        yield (
            f"| {b.case} | {b.bytes:,} | {number(b.ours_us)} | {number(b.zenoh_us)} "
            f"| {b.ratio:.2f} | {b.ours_per_second:,.0f} | {b.zenoh_per_second:,.0f} |"
        )
    yield "\nAn image as a message of ROS 2, by the bridge and by rosbags' `serialize_cdr`:\n"
    yield "| image | bytes | µs | rosbags' | ratio |"
    yield "|---|--:|--:|--:|--:|"
    for i in results.ros_images:
        yield (
            f"| {i.case} | {i.bytes:,} | {number(i.ours_us)} | {number(i.rosbags_us)} "
            f"| {i.ratio:.2f} |"
        )
    yield "\nLateness of a 400 Hz tick while a run with 512×512 RGB-D at 30 Hz is recorded:\n"
    yield "| run | late p50 µs | p99 µs | max µs | pairs' ratio of p99 | MB | dropped |"
    yield "|---|--:|--:|--:|--:|--:|--:|"
    for r in results.recording:
        yield (
            f"| {r.case} | {r.late_p50_us:.0f} | {r.late_p99_us:.0f} | {r.late_max_us:.0f} "
            f"| {r.ratio_p99:.2f} | {r.megabytes:.0f} | {r.dropped} |"
        )
    yield "\nThe same while messages of ROS 2 come from another process:\n"
    yield "| window | messages a second | late p50 µs | p99 µs | pairs' ratio of p99 |"
    yield "|---|--:|--:|--:|--:|"
    for f in results.flood:
        yield (
            f"| {f.case} | {f.messages_per_second:,.0f} | {f.late_p50_us:.0f} "
            f"| {f.late_p99_us:.0f} | {f.ratio_p99:.2f} |"
        )
    yield ""


def _latency(
    rows: Sequence[Row], case: str, title: str, plots: Sequence[str], folder: str
) -> Iterator[str]:
    yield f"## {title}: median round trip, µs\n"
    for place in ("one process", "processes"):
        own = [r for r in rows if r.case == case and r.place == place]
        if not own:
            continue
        nodes = sorted({r.nodes for r in own})
        yield f"Nodes in {'one process' if place == 'one process' else 'processes of their own'}:\n"
        yield f"| system | mode | {' | '.join(map(str, nodes))} |"
        yield f"|---|---|{'--:|' * len(nodes)}"
        by_system: dict[tuple[str, str], dict[int, float]] = {}
        for r in own:
            by_system.setdefault((r.system, r.mode), {})[r.nodes] = r.median_us
        for (system, mode), medians in sorted(by_system.items(), key=lambda s: min(s[1].values())):
            cells = " | ".join(number(medians.get(n)) for n in nodes)
            yield f"| {system} | {mode} | {cells} |"
        yield ""
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


def _plots(rows: Sequence[Row], out: Path) -> dict[str, list[str]]:
    """Draw each case's plots and return their names."""
    drawn: dict[str, list[str]] = {}
    for case in dict.fromkeys(row.case for row in rows):
        own = [row for row in rows if row.case == case]
        names = drawn.setdefault(case, [])
        if len({row.nodes for row in own}) > 1:
            names.append(f"{case}-scaling.png")
            plot_scaling(own, f"{case} message", out / names[-1])
        for n in (2, 128):
            boxed = [row for row in own if row.nodes == n]
            if boxed:
                names.append(f"{case}-{n}.png")
                plot_boxes(boxed, f"{case} message, {n} nodes", out / names[-1])
    return drawn
