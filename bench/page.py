"""Page of results, ``RESULTS.md``: figures by ``page.md.jinja``, and plots."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from bench.benchmarks import BENCHMARKS, ROUND_TRIPS, SECTIONS, Row, latency
from bench.results import encode

OURS = "visnav"


def write(results: Mapping[str, Any], out: Path, page_path: Path) -> None:
    """Write the page of results, its plots, and the figures themselves."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "results.json").write_bytes(encode(results, indent=1))
    plots = draw(results["rows"], out, (2, 128))
    folder = os.path.relpath(out, page_path.parent)
    page_path.write_text(page(results, plots, folder), encoding="utf-8")


def page(results: Mapping[str, Any], plots: Mapping[str, Sequence[str]], folder: str) -> str:
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
        sections=SECTIONS,
        benchmarks=BENCHMARKS,
        cases=ROUND_TRIPS,
        latency=latency,
        plots=plots,
        folder=folder,
    )
    return text.rstrip() + "\n"


def _goals(results: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    yield from _latency_goals(results["rows"])
    burst = next(row for row in results["throughput"] if "one wake" in row["case"])
    microseconds = f"{burst['per_event_us']:.2f} µs"
    yield "burst of 256 events in one wake, each", "", "", microseconds, "≤ 0.5 µs"
    late = "p99 lateness of a 400 Hz tick"
    p99 = {row["mode"]: row["late_p99_us"] for row in results["stall"]}
    ratio = f"{p99['worker'] / p99['none']:.2f}"
    yield f"{late}, camera in a worker", "no camera", "", ratio, "≤ 1.25"
    percent = f"{results['idle']['cpu_percent']:.2f} %"
    yield "processor time of a 100 Hz timer", "one core", "", percent, "≤ 1 %"
    for row in results.get("bridge", []):
        mark = "≤ 2" if row["bytes"] < 1000 else "≤ 1.3"
        yield f"{row['case']} to another process and back", "Zenoh", 2, f"{row['ratio']:.2f}", mark
    for name, what, beside, mark in (
        ("recording", "{case}", "no recorder", "≤ 1.25"),
        ("flood", "{messages_per_second:,.0f} messages a second", "quiet", "≤ 1.5"),
        ("airsim", "AirSim's client asks for {case}", "quiet", "≤ 1.25"),
    ):
        for row in results.get(name, [])[1:]:
            yield f"{late}, {what.format(**row)}", beside, "", f"{row['ratio_p99']:.2f}", mark


def _latency_goals(rows: Sequence[Row]) -> Iterator[tuple[Any, ...]]:
    medians = {(r["case"], r["system"], r["mode"], r["nodes"]): r["median_us"] for r in rows}
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


def draw(rows: Sequence[Row], out: Path, boxes: Iterable[int]) -> dict[str, list[str]]:
    """Draw the plots of each case into a folder, made if missing; return their names by case.

    Args:
        boxes: Numbers of nodes that get a box plot, where there are rows with so many.
    """
    out.mkdir(parents=True, exist_ok=True)
    drawn: dict[str, list[str]] = {}
    for case in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == case]
        names = drawn.setdefault(case, [])
        if len({row["nodes"] for row in own}) > 1:
            names.append(f"{case}-scaling.png")
            plot_scaling(own, f"{case} message", out / names[-1])
        for n in boxes:
            if boxed := [row for row in own if row["nodes"] == n]:
                names.append(f"{case}-{n}.png")
                plot_boxes(boxed, f"{case} message, {n} nodes", out / names[-1])
    return drawn


def label(row: Row) -> str:
    """Return a row's label: system and mode."""
    return f"{row['system']}, {row['mode']}"


def _colour(name: str, index: int) -> Any:
    from matplotlib import colormaps

    return "#c1121f" if name.startswith(OURS) else colormaps["tab20"](index % 20)


def plot_scaling(rows: Sequence[Row], title: str, out: Path) -> None:
    """Draw the median against the number of nodes, with the quartiles as a band."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes: Any = figure.add_subplot()
    last = {label(r): r["median_us"] for r in sorted(rows, key=lambda r: r["nodes"])}
    styles = {"handler": "-", "stream": "--", "routed": ":"}
    for index, name in enumerate(sorted(last, key=lambda n: -last[n])):
        own = sorted((r for r in rows if label(r) == name), key=lambda r: r["nodes"])
        colour, n = _colour(name, index), [r["nodes"] for r in own]
        axes.plot(
            n,
            [r["median_us"] for r in own],
            styles[own[0]["mode"]],
            marker=".",
            color=colour,
            lw=2.4 if name.startswith(OURS) else 1.2,
            label=name,
        )
        axes.fill_between(
            n, [r["q1_us"] for r in own], [r["q3_us"] for r in own], color=colour, alpha=0.12, lw=0
        )
    ticks = sorted({r["nodes"] for r in rows})
    axes.set(xscale="log", yscale="log", xlabel="nodes", ylabel="round trip (µs)", title=title)
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(out, dpi=120)


def plot_boxes(rows: Sequence[Row], title: str, out: Path) -> None:
    """Draw a box (quartiles, median) with whiskers to the 99th percentile for each system."""
    own = sorted(rows, key=lambda r: r["median_us"], reverse=True)
    figure = Figure(figsize=(9, 0.9 + 0.34 * len(own)), layout="constrained")
    axes: Any = figure.add_subplot()
    boxes = [
        {
            "label": label(r),
            "med": r["median_us"],
            "q1": r["q1_us"],
            "q3": r["q3_us"],
            "whislo": r["q1_us"],
            "whishi": r["p99_us"],
        }
        for r in own
    ]
    drawn = axes.bxp(boxes, orientation="horizontal", showfliers=False, patch_artist=True)
    for row, box in zip(own, drawn["boxes"], strict=True):
        box.set_facecolor("#f2b5b8" if row["system"].startswith(OURS) else "#dcebf7")
    axes.set(xscale="log", xlabel="round trip (µs); whiskers to the 99th percentile", title=title)
    axes.grid(alpha=0.3, axis="x", which="both")
    figure.savefig(out, dpi=120)
