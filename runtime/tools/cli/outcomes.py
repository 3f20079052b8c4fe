"""Outcomes of runs for continuous integration: JUnit's XML, and JSON.

One vocabulary: ``crashed`` came to no end of its own, ``failed`` missed a threshold, ``passed``
met them all, and ``not judged`` was asked for none. The XML is that of pytest and Jenkins: a test
suite, with a test case for each run and estimator; ``crashed`` is an error, ``not judged`` skipped.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from xml.etree import ElementTree as ET

import msgspec
import typer

if TYPE_CHECKING:
    from runtime.summary import Verdict
    from runtime.tools.sweep import Row

JUnit = Annotated[
    Path | None, typer.Option(help="Write who passed as JUnit's XML, for continuous integration.")
]
Json = Annotated[
    Path | None, typer.Option("--json", help="Write who passed, with all figures, as JSON.")
]

State = Literal["passed", "failed", "crashed", "not judged"]

_STATES: dict[bool | None, State] = {True: "passed", False: "failed", None: "not judged"}


NOBODY = "thresholds were given, and no estimator announced itself or sent a pose"
"""Reason for the failure of a run without estimators."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of a run for one of its estimators, or of a flight of which something was asked.

    Attributes:
        estimator: Its source, or ``flight of`` a vehicle; empty for a run without any.
        reasons: Sentences on a failure or crash.
        seconds: Real time of the whole run.
        figures: All figures, as in ``evaluation/verdict.json``.
    """

    run: str
    estimator: str = ""
    state: State
    reasons: list[str] = []
    seconds: float | None = None
    figures: dict[str, Any] = {}


def of_verdict(run: str, verdict: Verdict | None, seconds: float | None = None) -> list[Outcome]:
    """Return the outcomes of a run that came to an end."""
    judged = dict(verdict.estimators) if verdict else {}
    for vehicle, figures in (verdict.flights if verdict else {}).items():
        if figures["passed"] is not None:
            judged[f"flight of {vehicle}"] = figures
    if verdict is None or not judged:
        state = _STATES[verdict.passed if verdict else None]
        reasons = [NOBODY] if state == "failed" else []
        return [Outcome(run=run, state=state, reasons=reasons, seconds=seconds)]
    return [
        Outcome(
            run=run,
            estimator=name,
            state=_STATES[figures["passed"]],
            reasons=[str(each) for each in figures.get("failed", ())],
            seconds=seconds,
            figures=figures,
        )
        for name, figures in judged.items()
    ]


def of_rows(names: Iterable[str], rows: Iterable[Row]) -> list[Outcome]:
    """Return the outcomes of a sweep's runs."""
    from runtime.summary import Verdict

    found: list[Outcome] = []
    for name, row in zip(names, rows, strict=True):
        if row["error"]:
            crashed = Outcome(
                run=name, state="crashed", reasons=[row["error"]], seconds=row["wall_seconds"]
            )
            found.append(crashed)
        else:
            verdict = Verdict(row["passed"], row["estimators"], row.get("flights", {}))
            found += of_verdict(name, verdict, row["wall_seconds"])
    return found


@contextlib.contextmanager
def writing(name: str, junit: Path | None, json: Path | None) -> Iterator[list[Outcome]]:
    """Yield a list for outcomes, written at the end as a test suite; an exception is one of them.

    Raises:
        OSError: A file cannot be written.
    """
    outcomes: list[Outcome] = []
    try:
        yield outcomes
    except Exception as error:
        outcomes.append(Outcome(run=name, state="crashed", reasons=[str(error)]))
        raise
    finally:
        if junit is not None:
            _write(junit, to_junit(name, outcomes))
        if json is not None:
            _write(json, msgspec.json.format(msgspec.json.encode(outcomes), indent=2) + b"\n")


def to_junit(name: str, outcomes: Sequence[Outcome]) -> bytes:
    """Return JUnit's XML (github.com/testmoapp/junitxml describes it)."""
    number = Counter(each.state for each in outcomes)
    total = {
        "name": _printable(name),
        "tests": str(len(outcomes)),
        "failures": str(number["failed"]),
        "errors": str(number["crashed"]),
        "skipped": str(number["not judged"]),
        "time": f"{math.fsum(each.seconds or 0.0 for each in outcomes):.3f}",
    }
    suites = ET.Element("testsuites")
    suite = ET.SubElement(suites, "testsuite", total)
    elements = {"failed": "failure", "crashed": "error", "not judged": "skipped"}
    for each in outcomes:
        case = ET.SubElement(
            suite,
            "testcase",
            {
                "classname": _printable(each.run),
                "name": _printable(each.estimator or "run"),
                "time": f"{each.seconds or 0.0:.3f}",
            },
        )
        if each.state != "passed":
            reasons = [_printable(reason) for reason in each.reasons] or [each.state]
            said = ET.SubElement(case, elements[each.state], {"message": reasons[0]})
            said.text = "\n".join(reasons)
    ET.indent(suites)
    return bytes(ET.tostring(suites, encoding="utf-8", xml_declaration=True)) + b"\n"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() or c in "\n\t" else "�" for c in text)


def _write(path: Path, content: bytes) -> None:
    from runtime.run import results

    path.parent.mkdir(parents=True, exist_ok=True)
    results.write(path, content)
