"""Tables of figures for papers, as LaTeX (booktabs), Markdown or CSV.

A row is an estimator, alone or with a combination of settings; a column is a figure with its unit
and an arrow to the better values. LaTeX and Markdown have rounded medians, ranges, the best of a
column in bold, and a dagger at what failed; CSV has all digits and no marks. A table is printed and
nothing else, so that ``> table.tex`` makes a file.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from runtime.errors import CommandError, expect_known
from runtime.figures import FIGURES, figure
from runtime.units import significant

if TYPE_CHECKING:
    from runtime.summary import Verdict
    from runtime.tools.comparison import Comparison
    from runtime.tools.sweep.tables import Combination

Format = Literal["latex", "markdown", "csv"]

DIGITS = 3
_UNKNOWN = "–"
_FAILED = "† failed: a threshold was missed, or a run crashed"
_RANGE = "median (least–most) of the runs"


class Cell(msgspec.Struct, frozen=True):
    """A cell.

    Attributes:
        failed: Whether it gets a dagger: a row's name, or a figure that missed its threshold.
    """

    text: str
    best: bool = False
    failed: bool = False


class Column(msgspec.Struct, frozen=True):
    """A column; `better` is the side of its better values."""

    heading: str
    unit: str = ""
    better: Literal["", "less", "more"] = ""
    number: bool = False


class Table(msgspec.Struct, frozen=True):
    """A table.

    Attributes:
        groups: Rows, by groups between which there is a rule.
        notes: Below the table.
        details: Why rows failed: comments in LaTeX, a list in Markdown.
        records: Rows of the CSV: value by heading.
    """

    columns: Sequence[Column]
    groups: Sequence[Sequence[Sequence[Cell]]]
    notes: Sequence[str]
    details: Sequence[str]
    records: Sequence[dict[str, Any]]


def typeset(table: Table, form: Format) -> str:
    """Return a table's text, with a line end."""
    return {"latex": _latex, "markdown": _markdown, "csv": _csv}[form](table)


def combinations_of(
    verdict: Verdict | None, figures: Iterable[str], error: str | None = None
) -> list[Combination]:
    """Return a row for each estimator of a single run; of a run that crashed, one without a name.

    Raises:
        CommandError: Nobody was judged.
    """
    from runtime.tools.sweep.tables import Row, combine

    estimators = verdict.estimators if verdict else {}
    if not estimators and not error:
        raise CommandError("expected estimators that were judged, found none")
    row = Row(
        id="", parameters={}, seed=0, exit_code=None, error=error or "", passed=None, digest=None,
        sim_seconds=None, run_seconds=None, wall_seconds=None, estimators=estimators,
    )  # fmt: skip
    return [combine((), name, [row], figures) for name in estimators or [""]]


def columns_of(chosen: Sequence[str], estimators: Iterable[dict[str, Any]]) -> list[str]:
    """Return the figures of a table: those chosen, or the main ones that somebody has.

    Raises:
        CommandError: A chosen one is no number that anybody has.
    """
    from runtime.tools.sweep.tables import MAIN

    numbers = {
        name: None
        for figures in estimators
        for name, value in figures.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    for name in chosen:
        message = f"--figure {name}: expected a figure of the results"
        expect_known(
            name, {**numbers, **FIGURES}, f"{message}, found none of this name", CommandError
        )
    return [*dict.fromkeys(chosen)] or [name for name in MAIN if name in numbers]


def figures_table(
    rows: Sequence[Combination], settings: Sequence[str], figures: Sequence[str], groups: int = 0
) -> Table:
    """Return the table of figures over the runs of each row.

    The best of a column is looked for among rows without a failure: who gives up early errs less.
    Errors after different alignments are not compared.

    Args:
        settings: Headings of the rows' settings.
        groups: Settings, from the first on, whose values are compared each on its own.
    """
    aligned = list(dict.fromkeys(row.alignment for row in rows if row.alignment))
    several = any(row.runs > 1 for row in rows)
    columns = [*(Column(name) for name in settings), Column("estimator")]
    if len(aligned) > 1:
        columns.append(Column("alignment"))
    if several:
        columns.append(Column("runs", number=True))
    for name in figures:
        entry = figure(name)
        columns.append(Column(entry.column, entry.unit, entry.better, number=True))
    blocks = []
    for _, block in groupby(rows, key=lambda row: row.settings[:groups]):
        members = [*block]
        best = {name: _best(members, name) for name in figures}
        blocks.append([[*_names(row, len(aligned) > 1, several),
                        *(_figure_cell(row, name, best[name]) for name in figures)]
                       for row in members])  # fmt: skip
    notes = [f"alignment: {aligned[0]}"] if len(aligned) == 1 else []
    if several:
        notes.append(_RANGE)
    if any(_failures(row) for row in rows):
        notes.append(_FAILED)
    details = [f"{_label(row)}: {'; '.join(row.reasons)}" for row in rows if row.reasons]
    records = [_record(row, settings, figures, several=several) for row in rows]
    return Table(columns, blocks, notes, details, records)


def _failures(row: Combination) -> int:
    return min(row.failed + row.crashed, row.runs)


def _label(row: Combination) -> str:
    return ", ".join(filter(None, [*row.settings, row.estimator])) or "the run"


def _names(row: Combination, aligned: bool, several: bool) -> Iterator[Cell]:
    yield from map(Cell, row.settings)
    failures = _failures(row)
    count = f" ({failures} of {row.runs})" if failures and row.runs > 1 else ""
    yield Cell((row.estimator or "crashed") + count, failed=bool(failures))
    if aligned:
        yield Cell(row.alignment or _UNKNOWN)
    if several:
        yield Cell(str(row.runs))


def _figure_cell(row: Combination, name: str, best: str) -> Cell:
    spread = row.figures.get(name)
    missed = any(reason.startswith(f"{name}: ") for reason in row.reasons)
    if spread is None:
        return Cell(_UNKNOWN, failed=missed)
    median, *ends = (significant(v, DIGITS) for v in (spread.median, spread.least, spread.most))
    text = median if ends[0] == ends[1] else f"{median} ({ends[0]}–{ends[1]})"
    return Cell(text, best=median == best and not _failures(row), failed=missed)


def _best(rows: Sequence[Combination], name: str) -> str:
    """Return the best median as it is shown; "" if none is, or if all are the same."""
    better = figure(name).better
    with_value = [row for row in rows if name in row.figures]
    passed = [row.figures[name].median for row in with_value if not _failures(row)]
    alignments = {row.alignment for row in with_value}
    if not better or not passed or (figure(name).after_alignment and len(alignments) > 1):
        return ""
    best = significant(min(passed) if better == "less" else max(passed), DIGITS)
    best_texts = {significant(row.figures[name].median, DIGITS) for row in with_value}
    return best if best_texts != {best} else ""


def _record(
    row: Combination, settings: Sequence[str], figures: Sequence[str], *, several: bool
) -> dict[str, Any]:
    state = "passed" if row.passed is not None else "not judged"
    if row.failed:
        state = "failed"
    if row.crashed:
        state = "crashed"
    record: dict[str, Any] = dict(zip(settings, row.settings, strict=True))
    record |= {"estimator": row.estimator, "alignment": row.alignment, "state": state}
    if several:
        record |= {"runs": row.runs, "failed": row.failed, "crashed": row.crashed}
    for name in figures:
        spread = row.figures.get(name)
        unit = f" [{unit}]" if (unit := figure(name).unit) else ""
        for statistic in ("median", "least", "most") if several else ("median",):
            heading = f"{name} {statistic}{unit}" if several else f"{name}{unit}"
            record[heading] = None if spread is None else getattr(spread, statistic)
    return record | {"reasons": "; ".join(row.reasons)}


def comparison_table(rows: Sequence[Comparison]) -> Table:
    """Return the table of a comparison: a row for each figure, the better side in bold."""
    columns = [
        Column("estimator"), Column("figure"), Column("unit"), Column("A", number=True),
        Column("B", number=True), Column("change B − A", number=True), Column("interval"),
        Column("flights", number=True), Column("verdict"),
    ]  # fmt: skip
    cells = []
    for row in rows:
        entry = figure(row.figure)
        texts = [_UNKNOWN if v is None else significant(v, DIGITS) for v in (row.a, row.b)]
        a, b = (
            Cell(
                text + f" ({lost} failed)" * bool(lost),
                best=row.verdict == side,
                failed=bool(lost),
            )
            for text, lost, side in zip(texts, row.failures, ("worse", "better"), strict=True)
        )
        change, low, high = (_signed(value) for value in (row.change, row.low, row.high))
        cells.append([
            Cell(row.estimator), Cell(entry.column), Cell(entry.unit), a, b,
            Cell(f"{change} {row.unit}".rstrip()), Cell(f"{low} to {high}"), Cell(str(row.pairs)),
            Cell(row.words),
        ])  # fmt: skip
    notes = ["medians of the flights"]
    if any(any(row.failures) for row in rows):
        notes.append("† failed: a run crashed, or has no such figure")
    records = [
        {
            "estimator": row.estimator, "figure": row.figure, "unit": figure(row.figure).unit,
            "A": row.a, "B": row.b, "change": row.change, "low": row.low, "high": row.high,
            "unit of the change": row.unit, "p": row.p, "flights": row.pairs,
            "failed in A": row.failures[0], "failed in B": row.failures[1], "verdict": row.words,
        }
        for row in rows
    ]  # fmt: skip
    return Table(columns, [cells], notes, [], records)


def _signed(value: float) -> str:
    return f"{value:+.3g}".replace("inf", "∞")


_ARROWS = {"": "", "less": "↓", "more": "↑"}


def _head(column: Column) -> str:
    unit = f"({column.unit})" if column.unit else ""
    return " ".join(filter(None, (column.heading, unit, _ARROWS[column.better])))


_TEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "_": r"\_", "%": r"\%", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': "''",
    "[": "{[}", "*": "{*}",  # which a line end before them would take for an argument of its own
    "–": "--", "−": "$-$", "†": r"$^\dagger$", "↓": r"$\downarrow$", "↑": r"$\uparrow$",
    "°": r"$^\circ$", "µ": r"$\mu$", "×": r"$\times$", "∞": r"$\infty$", "²": "$^2$",
    "≥": r"$\geq$", "≤": r"$\leq$",
}  # fmt: skip
_MINUS = re.compile(r"(?<![\w.)-])-(?=[\d∞])")  # of a number, not of a name such as orb-slam3


def _tex(text: str) -> str:
    plain = _MINUS.sub("−", _line(text))
    return "".join(_TEX.get(letter, letter) for letter in plain)


def _line(text: str) -> str:
    """Return a text in one line, without control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _marked(cell: Cell, escape: Callable[[str], str], bold: str) -> str:
    text = bold.format(escape(cell.text)) if cell.best else escape(cell.text)
    return text + escape("†") * cell.failed


def _latex(table: Table) -> str:
    width = len(table.columns)
    lines = ["% \\usepackage{booktabs}", *(f"% {_line(detail)}" for detail in table.details)]
    lines.append(f"\\begin{{tabular}}{{{''.join('lr'[c.number] for c in table.columns)}}}")
    lines += ["\\toprule", f"{' & '.join(_tex(_head(c)) for c in table.columns)} \\\\", "\\midrule"]
    for index, block in enumerate(table.groups):
        lines += ["\\midrule"] * bool(index)
        lines += [
            " & ".join(_marked(cell, _tex, "\\textbf{{{}}}") for cell in row) + " \\\\"
            for row in block
        ]
    lines.append("\\bottomrule")
    lines += [
        f"\\multicolumn{{{width}}}{{l}}{{\\footnotesize {_tex(note)}}} \\\\" for note in table.notes
    ]
    return "\n".join([*lines, "\\end{tabular}"]) + "\n"


def _md(text: str) -> str:
    return re.sub(r"([\\|`*_<\[\]~])", r"\\\1", _line(text))


def _markdown(table: Table) -> str:
    lines = [
        [_md(_head(column)) for column in table.columns],
        ["--:" if column.number else ":--" for column in table.columns],
        *(
            [_marked(cell, _md, "**{}**") for cell in row]
            for block in table.groups
            for row in block
        ),
    ]
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    notes = "".join(f"\n{_md(note)}\n" for note in table.notes)
    details = "".join(f"- {_md(detail)}\n" for detail in table.details)
    return text + notes + (f"\n{details}" if details else "")


def _csv(table: Table) -> str:
    file = io.StringIO()
    writer = csv.writer(file)  # which quotes and ends lines as RFC 4180 asks for
    headings = list(dict.fromkeys(heading for record in table.records for heading in record))
    writer.writerow(headings)
    writer.writerows([record.get(heading) for heading in headings] for record in table.records)
    return file.getvalue()
