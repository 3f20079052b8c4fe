"""Whatever stands in a file, reading it gives settings, or one line that says what is wrong."""

from __future__ import annotations

import io
import sys
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.config.model import to_builtins
from runtime.config.reading import load
from runtime.errors import ConfigError
from runtime.tools.cli import main

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "config.toml").read_text(encoding="utf-8")
TOKENS = [
    "=", "[", "]", "[[", "]]", "{", "}", '"', "'", ",", "\n", "#", ".", "-", "0", "1", "1e999",
    "nan", "inf", "-inf", "true", "''", "[]", "{}", "1979-05-27", "07:32:00", "0xfffffffffffffffff",
    "9" * 30, "9" * 400, "-1", "\\u0000", "\x00", "\ud7ff", "€", "[[nodes]]\n", "[run]\n", "nodes",
    "run", "name", "type", "inputs = {a = 'b'}\n", "links = {a = 1}\n", "on_error = 'x'\n",
    "network.meet = ''\n", "0x" + "f" * 5000, "1_0", "'''", '"40ms"', "40", "\r",
]  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn) -> str:
    """Return our file with a few pieces cut out, put in, doubled or swapped."""
    text = TEXT
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.integers(0, 12) | st.integers(0, 400)))
        piece = draw(st.sampled_from(TOKENS) | st.text(max_size=5) | st.just(text[start:end] * 2))
        text = text[:start] + piece + text[end:]
    return text


@st.composite
def with_other_values(draw: st.DrawFn) -> str:
    """Return our file with the values of some settings replaced: it stays TOML."""
    lines = TEXT.splitlines()
    values = st.sampled_from([token for token in TOKENS if "\n" not in token])
    for number in draw(st.lists(st.sampled_from(range(len(lines))), min_size=1, max_size=4)):
        key, equals, _ = lines[number].partition("=")
        if equals and not key.lstrip().startswith("#"):
            lines[number] = f"{key}= {draw(values)}"
    return "\n".join(lines)


def read(data: bytes) -> None:
    """Read a file with these bytes, and what it comes to again."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.toml"
        path.write_bytes(data)
        try:
            config = load(path)
        except ConfigError as error:
            message = str(error)
            assert "c.toml" in message
            assert len(message.splitlines()) == 1, message
            assert len(message) < 2000
        else:
            to_builtins(config)


FUZZ = settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow], deadline=None)


@FUZZ
@given(mutated() | with_other_values())
def test_a_spoilt_file_is_settings_or_one_line(text: str) -> None:
    read(text.encode("utf-8", "surrogatepass"))


@FUZZ
@given(st.binary(max_size=200))
def test_bytes_are_settings_or_one_line(data: bytes) -> None:
    read(data)


HARD = {
    "a number of 4,301 digits": f"[run]\nseed = {'1' * 4301}\n",
    "a hexadecimal number of 5,000 digits": f"[run]\nseed = 0x{'f' * 5000}\n{TEXT}",
    "100,000 brackets": f"a = {'[' * 100_000}",
    "100,000 tables": "a = " + "{a=" * 100_000,
    "a key of 1,000 parts": f"{'a.' * 1_000}a = 1",
    "a negative number of that size": f"[run]\nduration = -0x{'f' * 5000}\n".replace("-0x", "0x"),
    "a word of a megabyte": f"[run]\nclock = '{'x' * 1_000_000}'",
    "lines in a word": "[run]\nclock = 'a\\nb'\n".replace("'", '"'),
}


@pytest.mark.parametrize("text", HARD.values(), ids=HARD)
def test_what_is_hard_to_read_is_one_line(text: str) -> None:
    read(text.encode())


@pytest.mark.parametrize("data", [b"\xff\xfe", b"[run]\nname = '\xe9'", b"\x00", b""])
def test_what_is_no_text_is_one_line(data: bytes) -> None:
    read(data)


@pytest.mark.parametrize(
    "value",
    ["1" * 5000, "[" * 100_000, "0x" + "f" * 5000, "1\nother = 2", '"', "", "\x00", "{a=1}"],
)
def test_a_hard_value_on_the_command_line_is_one_line(value: str, tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(TEXT, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load(path, [f"run.seed={value}"])
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.slow
@pytest.mark.timeout(600)
@settings(max_examples=60, deadline=None)
@given(mutated() | with_other_values())
def test_a_check_of_a_spoilt_file_never_ends_in_a_traceback(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        words = ["runtime", "check", str(path)]
        out, err = io.StringIO(), io.StringIO()
        with (
            mock.patch.object(sys, "argv", words),
            redirect_stdout(out),
            redirect_stderr(err),
            pytest.raises(SystemExit) as caught,
        ):
            main()
        said = err.getvalue()
        assert "Traceback" not in said
        assert all(line.startswith(("error: ", "warning: ")) for line in said.splitlines()), said
        assert caught.value.code == (2 if "error: " in said else 0)
