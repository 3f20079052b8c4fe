"""JSON as people write it, with comments and the like, made into strict JSON and values."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from typing import Any

from runtime.errors import ConfigError

DEEPEST = 32
"""Levels of objects and lists in one another."""

_TOKEN = re.compile(
    r"""(?P<string>"(?:[^"\\]|\\.)*(?:"|\Z)) | (?P<comment>//[^\n]*|/\*.*?(?:\*/|\Z))
    | (?P<comma>,) | (?P<open>[\[{]) | (?P<close>[\]}]) | (?P<nan>-?(?:NaN|Infinity))
    | [^\s"/,\[\]{}]+ | /""",
    re.DOTALL | re.VERBOSE,
)


def parse(text: str, where: str) -> tuple[dict[str, Any], str, list[str]]:
    """Read a text; comments, trailing commas, NaN and infinities are accepted.

    Args:
        text: Of the file.
        where: Begins the message of an error.

    Returns:
        Its values; the same without comments and trailing commas; what strict parsers would not
        have taken.

    Raises:
        ConfigError: It is no JSON, no object, or nested too deep.
    """
    strict, oddities = _strict(text.removeprefix("\ufeff"), where)
    repeated: list[str] = []

    def collect(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        counts = Counter(key for key, _ in pairs)
        repeated.extend(
            f"{key!r} stands there more than once: the last one counts"
            for key in counts
            if counts[key] > 1
        )
        return dict(pairs)

    try:
        table = json.loads(strict, object_pairs_hook=collect)
        json.dumps(table, ensure_ascii=False).encode()
    except json.JSONDecodeError as error:
        place = f"{where}: line {error.lineno}, column {error.colno}"
        raise ConfigError(f"{place}: expected JSON, found: {error.msg}") from None
    except UnicodeEncodeError:
        raise ConfigError(f"{where}: expected Unicode, found half a surrogate pair") from None
    except ValueError as error:  # of Python's int()
        raise ConfigError(f"{where}: expected numbers of a usual size, found: {error}") from None
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: expected an object {{…}}, found {strict.strip()!r:.80}")
    warnings = [
        f"{what} in line {', '.join(map(str, dict.fromkeys(lines)))}: AirSim itself refuses that"
        for what, lines in oddities.items()
    ]
    return table, strict, warnings + repeated


def _strict(text: str, where: str) -> tuple[str, dict[str, list[int]]]:
    """Blank what is no JSON, so that all else keeps its place; return also what was where."""
    parts: list[str] = []
    found: dict[str, list[int]] = defaultdict(list)
    end = depth = 0
    line, counted, comma = 1, 0, -1
    for token in _TOKEN.finditer(text):
        parts.append(text[end : token.start()])
        part, end, kind = token[0], token.end(), token.lastgroup
        line += text.count("\n", counted, token.start())
        counted = token.start()
        depth += (kind == "open") - (kind == "close")
        if depth > DEEPEST:
            raise ConfigError(
                f"{where}: line {line}: expected objects and lists at most {DEEPEST} deep"
            )
        if kind == "comment":
            found["a comment"].append(line)
            part = re.sub(r"\S", " ", part)
        elif kind == "nan":
            found[part].append(line)
        elif kind == "close" and comma >= 0:
            found["a trailing comma"].append(line)
            parts[comma] = " "
        if kind != "comment":
            comma = len(parts) if kind == "comma" else -1
        parts.append(part)
    return "".join([*parts, text[end:]]), found
