"""Columns of text files: by the names in a header, by the user's words, or by a known layout.

A name is that of many programs: ``x``, ``tx``, ``p_x``, ``p_RS_R_x``, ``POS_X``,
``field.pose.pose.position.x`` are all the position's. The user's words (``--columns``) are such
names, too; ``_`` skips a column, and ``sec``, ``ms``, ``us``, ``ns`` are a stamp in that unit. A
stamp's unit is the file's word or its format's habit, unless only another one makes a plausible
time and rate of them. A length's is the file's word, as in ``x [mm]``, or metres.
"""

from __future__ import annotations

import decimal
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from nodes.judging.readers.axes import AXES, UNDECLARED, Axes
from nodes.judging.readers.source import (
    Collected,
    Floats,
    Options,
    Source,
    Start,
    decimal_commas,
    is_number,
    with_decimal_comma,
)
from nodes.trajectory_files import Row
from runtime.time.clock import SECOND

UNITS = {"s": SECOND, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds of a unit of stamps."""

POSITION, QUATERNION, VELOCITY = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("vx", "vy", "vz")
_UPPER = ("11", "12", "13", "22", "23", "33")
ROTATION_COVARIANCE = tuple(f"pr{place}" for place in _UPPER)  # about the body's axes, rad²
POSITION_COVARIANCE = tuple(f"pt{place}" for place in _UPPER)  # m²

_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]")
_UNIT_NAMES = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "us": "us",
    "usec": "us", "ns": "ns", "nsec": "ns", "nsecs": "ns", "nanosec": "ns", "nanoseconds": "ns",
}  # fmt: skip
_STAMP_UNITS = _UNIT_NAMES | {  # in brackets
    "second": "s", "millisecond": "ms", "milliseconds": "ms", "microsecond": "us",
    "microseconds": "us", "nanosecond": "ns", "usecs": "us", "msecs": "ms",
}  # fmt: skip
LENGTHS = {"m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "km": 1e3}
"""Metres of a unit of positions; per second, of velocities."""
_LENGTH_UNITS = {name: name for name in LENGTHS} | {
    f"{prefix}{name}": f"{letter}m"
    for prefix, letter in (
        ("", ""), ("deci", "d"), ("centi", "c"), ("milli", "m"), ("micro", "u"), ("nano", "n"),
        ("kilo", "k"),
    )
    for name in ("meter", "meters", "metre", "metres")
}  # fmt: skip
_PER_SECOND = re.compile(r"(?:(?:/|per)s(?:ec|econd)?|[*.·]?s\^?\(?[-−]1\)?|[*.·]?s⁻¹)$")
_UNIT_WORDS = "|".join(name for name in _UNIT_NAMES if name != "s")
_STAMP = re.compile(
    r"(?:(?:.*[._])?(?:time_?stamps?|stamps?)|(?:ros_|sim_|unix_|gps_)?time|t|ts)"
    r"(?:_(?:\w+_)?(?P<unit>[a-z]+))?"
    rf"|(?:.*(?:stamp|time)[._]?)?(?P<name>{_UNIT_WORDS})"
)
_POSITION = (
    re.compile(r"(?:(?:p|t|pos|trans|translation)(?:_\w+)?_?)?([xyz])"),
    re.compile(r"(?:.*[._])?(?:position|translation)[._]?([xyz])"),
)
_QUATERNION = (
    re.compile(r"(?:q|quat|quaternion)(?:_\w+)?_?([wxyz])"),
    re.compile(r"(?:.*[._])?(?:orientation|rotation|quaternion)[._]([wxyz])"),
)
_NO_QUATERNION = re.compile(  # q0, q1, …; i, j, k, w; rx, ry, rz, rw
    r"(?:q|quat|quaternion|.*orientation)[._]?\w?|[ijkw]|(?:r|o|rot)_?w"
)
_VELOCITY = re.compile(r"v_(?:\w+)_[rw]_([xyz])")  # of a frame in a world: v_RS_R_x, v_WS_W_x


class Column(NamedTuple):
    """What a column holds: "stamp", "rest" (nanoseconds of it), x, qw, vx, pr11, …; or ""."""

    kind: str
    unit: str = ""  # of a stamp or a length, if its name has one: also an unknown one
    sure: bool = False  # whether the unit is the user's word


SKIPPED = Column("")

POINTS = "with a decimal point, not with a decimal comma"
"""What is expected of numbers with a comma."""


def column_of(name: str) -> Column:
    """Return what a column holds by its name, with a unit in brackets or without."""
    units = [_folded(unit).replace(" ", "") for unit in _UNIT.findall(name)]
    plain = _plain(name)
    if plain in {*ROTATION_COVARIANCE, *POSITION_COVARIANCE}:
        return Column(plain)
    if match := _STAMP.fullmatch(plain):
        if any(units):
            return Column("stamp", _unit(units, _STAMP_UNITS))
        named = match["unit"] or match["name"] or ""
        if named in _UNIT_NAMES or match["unit"] is None:
            return Column("stamp", _UNIT_NAMES.get(named, ""))
    for patterns, prefix in ((_POSITION, ""), (_QUATERNION, "q"), ((_VELOCITY,), "v")):
        for pattern in patterns:
            if match := pattern.fullmatch(plain):
                if prefix == "v":
                    units = [_PER_SECOND.sub("", unit) for unit in units]
                unit = _unit(units, _LENGTH_UNITS) if prefix != "q" else ""
                return Column(prefix + match[1], unit)
    return SKIPPED


def _plain(name: str) -> str:
    """Return a column's name, in small letters, without unit, quotes and a comment's sign."""
    return _folded(_UNIT.sub("", name).strip(' #%"'))


def _folded(text: str) -> str:
    """Return a text in small letters, and with u for the micro sign."""
    return text.casefold().replace("\N{GREEK SMALL LETTER MU}", "u")


def _unit(units: Sequence[str], known: dict[str, str]) -> str:
    """Return the unit among texts in brackets: one that is known, else the first text, or ""."""
    texts = [text for text in units if text]
    return next((known[text] for text in texts if text in known), texts[0] if texts else "")


def columns_of(names: Sequence[str]) -> list[Column] | None:
    """Return what columns hold by their names; `None` if that is no stamp, or no position.

    Raises:
        ValueError: Two columns hold the same, a quaternion is not whole, or a unit is unknown.
    """
    columns = [column_of(name) for name in names]
    if not {"stamp", *POSITION} <= {column.kind for column in columns}:
        return None
    _choose_stamp(names, columns)
    kinds = [column.kind for column in columns if column.kind]
    if twice := sorted({kind for kind in kinds if kinds.count(kind) > 1}):
        same = [name.strip() for name, c in zip(names, columns, strict=True) if c.kind == twice[0]]
        raise ValueError(f"expected one column of {twice[0]} (see --columns), found {same}")
    some = sorted({*QUATERNION} & {*kinds}) or [
        name.strip() for name in names if _NO_QUATERNION.fullmatch(_plain(name))
    ]
    if some and not {*QUATERNION} <= {*kinds}:
        raise ValueError(
            "expected four columns of a quaternion with w, x, y, z in their names, or none (see "
            f"--columns), found {', '.join(some)}"
        )
    for name, column in zip(names, columns, strict=True):
        known = UNITS if column.kind == "stamp" else LENGTHS
        if column.unit and column.unit not in known:
            per = " per second" if column.kind in VELOCITY else ""
            raise ValueError(
                f"expected the unit of {_UNIT.sub('', name).strip(' #%')!r} among "
                f"{', '.join(known)}{per} (see --columns), found {column.unit!r}"
            )
    for group in (POSITION, VELOCITY):  # "tx ty tz[mm]" is of all three
        units = {column.unit for column in columns if column.kind in group} - {""}
        if len(units) == 1:
            (unit,) = units
            columns = [c._replace(unit=unit) if c.kind in group else c for c in columns]
    return columns


def _choose_stamp(names: Sequence[str], columns: list[Column]) -> None:
    """Leave one stamp among the columns, a message's own if there is one, or its two parts."""
    stamps = [k for k, column in enumerate(columns) if column.kind == "stamp"]
    candidates = [k for k in stamps if "stamp" in _plain(names[k])] or stamps
    whole, rest = candidates[0], candidates[0] + 1
    parts = rest in stamps and (columns[whole].unit, columns[rest].unit) == ("s", "ns")
    for k in stamps:
        if k != whole:
            columns[k] = Column("rest") if parts and k == rest else SKIPPED


def columns_from(text: str) -> list[Column]:
    """Return the columns of the user's words, separated by blanks or commas, or `ValueError`."""
    names = [word for word in re.split(r"[,;\s]+", text) if word]
    for name in names:
        if name != "_" and not column_of(name).kind:
            raise ValueError(
                "--columns: expected names as sec (or ms, us, ns), x, y, z, qw, qx, qy, qz, or _ "
                f"for a column to skip, found {name!r}"
            )
    columns = columns_of(names)
    if columns is None:
        raise ValueError(
            '--columns: expected a stamp and x y z among them, as "sec x y z qw qx qy qz", found '
            f"{text!r}"
        )
    return [column._replace(sure=bool(column.unit)) for column in columns]


class Layout(NamedTuple):
    """How lines are split, and what their fields hold."""

    separator: str | None  # `None` for blanks
    columns: list[Column]
    unit: str = "s"  # of stamps, if neither their name nor their size gives it
    trailing: bool = False  # whether lines end with a separator


def separator_of(start: Start) -> str | None:
    """Return what separates the fields of the first row; `None` for blanks."""
    separators = ("\t", ";") if decimal_commas(start.row) else (",", "\t", ";")
    for separator in separators:
        if separator in start.row:
            names = start.head[-1] if start.head else ""
            if separator == "\t" and separator not in names:
                continue  # a table of blanks of any kind
            return separator
    return None


def fields_of(line: str, separator: str | None) -> list[str]:
    """Return the fields of a line; an empty one after a last separator is none."""
    fields = [field.strip() for field in line.split(separator)]
    return fields[:-1] if len(fields) > 1 and not fields[-1] else fields


def layout_by_header(start: Start) -> Layout | None:
    """Return the layout that a line of the head names, the last such; `None` if none does.

    Raises:
        ValueError: It names something twice, a quaternion in part, or an unknown unit; or it has a
            name less than the rows have fields, and it is not clear which.
    """
    separator = separator_of(start)
    fields = fields_of(start.row, separator)
    count = len(fields)
    unnamed: list[str] = []
    for line in reversed(start.head):
        comment = line.lstrip()[:1] in {"#", "%"}
        # A blank between a name and its unit is none between columns.
        joined = _UNIT.sub(
            lambda unit: f"[{unit[1].replace(' ', '')}]", line.lstrip(" ").strip("#%")
        )
        for sep in dict.fromkeys((separator, ",", None)):
            names = fields_of(joined, sep)
            if comment and names[:1] == [""] and len(names) > count:  # of the comment's sign
                names = names[1:]
            columns: list[Column] | None
            if len(names) == count or (separator == sep == "\t" and len(names) == count + 1):
                columns = columns_of(names)  # without the last field of the row, if it is empty
            elif sep == separator and len(names) == count - 1 and (sep == "\t" or not comment):
                unnamed = unnamed or names
                columns = columns_of(names) if _has_name(fields, names) else None
                columns = columns and [SKIPPED, *columns]
            else:
                continue
            if columns is not None:
                return Layout(separator, columns, _usual_unit(start, separator, columns))
    if unnamed and columns_of(unnamed):
        raise ValueError(
            f"expected a name for each of {count} fields, found {len(unnamed)} names: say what the "
            'columns are, as --columns "_ sec x y z" if the first one has no name'
        )
    return None


def _has_name(fields: Sequence[str], names: Sequence[str]) -> bool:
    """Return whether the first field is a row's name, of R's ``write.table``, in any case.

    It is one if it is no number, although the first column is one; or if a stamp before it would
    not be Unix time, and after it is.
    """
    place = next((k for k, name in enumerate(names) if column_of(name).kind == "stamp"), None)
    if place is None:
        return False
    if column_of(names[0]).kind and not is_number(fields[0]):
        return True
    return _is_unix_time(fields[place + 1]) and not _is_unix_time(fields[place])


def _is_unix_time(text: str) -> bool:
    """Return whether a number is Unix time of 2000 to 2100, in any unit."""
    return is_number(text) and any(
        _CALENDAR[0] <= float(text) * scale <= _CALENDAR[1] for scale in UNITS.values()
    )


def read_columns(
    path: Path,
    layout: Layout,
    *,
    axes: Axes = UNDECLARED,
    usual: Axes = UNDECLARED,
    group: int | None = None,  # column of a name, of rows that are several trajectories
    wanted: str = "",  # the one to read; needed if there are several
) -> Source:
    """Read a file of rows with a stamp, a position, and what else there is.

    Raises:
        ValueError: A row is too short, or has a word instead of a number; with file and line.
    """
    place = {column.kind: k for k, column in enumerate(layout.columns) if column.kind}
    rows = list(rows_of(path, layout))
    if group is not None:
        groups = [*dict.fromkeys(row.fields[group] for row in rows)]
        if (wanted or len(groups) > 1) and wanted not in groups:
            raise ValueError(
                f"{path}: expected one of {', '.join(groups)}, as {path.name}:{groups[0]}, found "
                f"{wanted or 'no name'!r}"
            )
        rows = [row for row in rows if row.fields[group] == (wanted or groups[0])]
    stamps = _stamps(rows, layout, place)
    oriented = "qw" in place
    moving = "vx" in place
    covariances = {*ROTATION_COVARIANCE, *POSITION_COVARIANCE} <= {*place}
    collected = Collected(str(path))
    for row, stamp in zip(rows, stamps, strict=True):
        quaternion = _numbers(row, place, QUATERNION) if oriented else None
        collected.add(
            stamp,
            _metres(row, layout, place, POSITION),
            quaternion,
            row=row.where.removeprefix(str(path)),
            velocity=_metres(row, layout, place, VELOCITY) if moving else None,
            covariance=_covariance(row, place, quaternion) if covariances and quaternion else None,
        )
    return collected.source(axes=axes, usual=usual)


def rows_of(path: Path, layout: Layout) -> Iterator[Row]:
    """Yield the rows of a file after its head; a `ValueError` of one with too few fields."""
    start = Start.of(path)
    assert start is not None  # as it was when the layout was found
    least = 1 + max(k for k, column in enumerate(layout.columns) if column.kind)
    expected = len(fields_of(start.row, layout.separator))
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected a text file of rows, found: {error}") from None
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.partition("#")[0]
        content = line.strip()
        if number < start.number or not content or content[0] == "%":
            continue
        row = Row(f"{path}:{number}", fields_of(line, layout.separator))
        count = len(row.fields)
        # Between tabs the last field may be empty.
        if count < least or abs(count - expected) > (layout.separator == "\t"):
            row.wrong(f"{expected} fields, as in the first row", f"{count}: {content}")
        yield row


def _numbers(row: Row, place: dict[str, int], kinds: Sequence[str]) -> list[float]:
    """Return fields as numbers, also infinite ones and NaN (an empty field); or `ValueError`."""
    fields = [row.fields[place[kind]] for kind in kinds]
    try:
        return [float(field) if field else np.nan for field in fields]
    except ValueError:
        row.wrong(_expected("finite numbers", fields), " ".join(fields))


def _expected(what: str, fields: Sequence[str]) -> str:
    """Return what is expected of fields, and that it has points, if one has a decimal comma."""
    return f"{what}, {POINTS}" if any(map(with_decimal_comma, fields)) else what


def _metres(row: Row, layout: Layout, place: dict[str, int], kinds: Sequence[str]) -> list[float]:
    """Return lengths (m), or velocities (m/s), from fields in the units of their columns."""
    units = [layout.columns[place[kind]].unit or "m" for kind in kinds]
    values = zip(_numbers(row, place, kinds), units, strict=True)
    return [value * LENGTHS[unit] for value, unit in values]


def _covariance(row: Row, place: dict[str, int], quaternion: Sequence[float]) -> Floats | None:
    """Return a pose's covariance in ROS's order, from upper triangles; OpenVINS' of the rotation.

    The rotation's is of a small turn in the body's axes (P. Geneva et al., "OpenVINS: A Research
    Platform for Visual-Inertial Estimation", ICRA 2020: the error is the left one of ``q_GtoI``),
    and turned into the frame's.
    """
    if not np.isfinite(quaternion).all() or not 0.9 < np.linalg.norm(quaternion) < 1.1:
        return None
    blocks = []
    for kinds in (POSITION_COVARIANCE, ROTATION_COVARIANCE):
        block = np.zeros((3, 3))
        block[np.triu_indices(3)] = _numbers(row, place, kinds)
        blocks.append(block + np.triu(block, 1).T)
    turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    whole = np.zeros((6, 6))
    whole[:3, :3], whole[3:, 3:] = blocks[0], turn @ blocks[1] @ turn.T
    return whole


_RATES = (1e-4, 100.0)  # seconds between poses that are plausible
_CALENDAR = (946_684_800 * SECOND, 4_102_444_800 * SECOND)  # Unix time of 2000 to 2100, ns
_DIGITS = 30  # of a stamp, at most
_TOO_LATE = 1 << 63  # first number of nanoseconds beyond 64 bits


def _stamps(rows: Sequence[Row], layout: Layout, place: dict[str, int]) -> list[int | None]:
    """Return the rows' stamps (ns), `None` for NaN, in the unit that is theirs."""
    column = layout.columns[place["stamp"]]
    if "rest" in place:
        both = [(_decimal(row, place["stamp"]), _decimal(row, place["rest"])) for row in rows]
        return [None if s is None or n is None else int(s) * SECOND + int(n) for s, n in both]
    return stamps_of(rows, place["stamp"], column.unit or layout.unit, sure=column.sure)


def stamps_of(
    rows: Sequence[Row], field: int, unit: str, *, sure: bool = False
) -> list[int | None]:
    """Return the stamps (ns) in a field, `None` for NaN; a `ValueError` of what is no stamp.

    Args:
        unit: Their unit, unless they make no sense in it, and do in another.
        sure: Whether it is the unit in any case.
    """
    values = [_decimal(row, field) for row in rows]
    if not sure:
        unit = _by_size([value for value in values if value is not None], unit)
    stamps: list[int | None] = []
    for row, value in zip(rows, values, strict=True):
        stamp = None if value is None else value * UNITS[unit]
        names = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
        if stamp is not None and not abs(stamp) < _TOO_LATE:
            row.wrong(f"a stamp in {names[unit]}", row.fields[field])
        if stamp is not None and unit == "ns" and stamp != stamp.to_integral_value():
            row.wrong("a stamp in whole nanoseconds", row.fields[field])
        stamps.append(None if stamp is None else int(stamp.to_integral_value()))
    return stamps


def _decimal(row: Row, field: int) -> decimal.Decimal | None:
    """Return a stamp as written; `None` for NaN; a `ValueError` of what is no number."""
    text = row.fields[field]
    try:
        value = decimal.Decimal(text) if text else decimal.Decimal("nan")
    except decimal.InvalidOperation:
        row.wrong(_expected("a stamp", [text]), text)
    if value.is_finite() and value.adjusted() > _DIGITS:
        row.wrong("a stamp", text)
    return value if value.is_finite() else None


def _by_size(values: Sequence[decimal.Decimal], unit: str) -> str:
    """Return the unit of stamps: the given one, unless only another one makes sense of them."""
    if not values:
        return unit
    steps = abs(np.diff(np.array([float(value) for value in values[:1000]])))
    steps = steps[steps > 0.0]
    first = float(values[0])

    def has_rate(name: str) -> bool:
        return bool(_RATES[0] <= np.median(steps) * UNITS[name] / SECOND <= _RATES[1])

    if not len(steps):
        known = abs(first) * UNITS[unit] <= _CALENDAR[1]
        others = UNITS
    else:
        known = has_rate(unit) and abs(first) * UNITS[unit] < _TOO_LATE
        others = {name: scale for name, scale in UNITS.items() if has_rate(name)}
    if known:
        return unit
    times = {name: first * scale for name, scale in others.items()}
    return next((n for n, time in times.items() if _CALENDAR[0] <= time <= _CALENDAR[1]), unit)


def read_named(path: Path, options: Options) -> Source:
    """Read a text file whose columns the user names (``--columns``), or its own header does."""
    start = Start.of(path)
    assert start is not None
    if not options.columns:
        layout = layout_by_header(start)
        assert layout is not None
        usual = AXES["nwu"] if layout.separator == "," else Axes()
        return read_columns(path, layout, usual=usual)
    columns = columns_from(options.columns)
    separator = separator_of(start)
    fields = fields_of(start.row, separator)
    if not start.number or len(fields) < len(columns):
        raise ValueError(
            f"{path}:{start.number}: expected {len(columns)} fields, as --columns says, found "
            f"{len(fields)}: {start.row[:60]!r}"
        )
    return read_columns(path, Layout(separator, columns, _usual_unit(start, separator, columns)))


def _usual_unit(start: Start, separator: str | None, columns: Sequence[Column]) -> str:
    """Return the habit of files: nanoseconds are whole numbers, with commas between."""
    place = next(k for k, column in enumerate(columns) if column.kind == "stamp")
    stamp = fields_of(start.row, separator)[place]
    return "ns" if separator == "," and stamp.lstrip("+-").isdecimal() else "s"
