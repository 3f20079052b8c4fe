"""The documentation is true: its snippets run, its files are valid, its commands exist."""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import shlex
import signal
import socket
import subprocess
import sys
import tomllib
import types
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jsonschema
import pytest

from runtime.config.reading import find_node, load
from runtime.tools.cli.run import chosen
from runtime.tools.suite.plan import read_suite
from tests.runtime.tools.samples_cli import command_here, start, summary

ROOT = Path(__file__).parents[1]
SCHEMA = json.loads((ROOT / "docs/reference/config.schema.json").read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft7Validator(SCHEMA)
PAGES = sorted(
    [
        *(ROOT / "docs").rglob("*.md"),
        *ROOT.glob("extensions/*/docs/*.md"),
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "tools/configuration.md")),
    ]
)
ABOUT_FILES = {"pyproject.toml"}
"""Titles of blocks in TOML that are no configuration."""

PACKAGE = "examples/package/"
"""Begins titles of files of a package that tests/examples/test_package.py builds and runs."""

SESSION = "thirty-minutes.md"
"""The page whose blocks make sense in order only; tests/test_tutorial.py runs it."""

ELSEWHERE = "import cosysairsim"
"""Marks a script for AirSim's client, which extensions/airsim/tests/test_examples.py runs."""


class Block(NamedTuple):
    """A fenced block of a page."""

    page: Path
    language: str
    title: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.title or self.text.split(chr(10))[0][:40]}"


def blocks(*languages: str) -> list[Block]:
    """Return the fenced blocks of all pages in these languages."""
    result = []
    for page in PAGES:
        for match in re.finditer(
            r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$',
            page.read_text(encoding="utf-8"),
            re.MULTILINE | re.DOTALL,
        ):
            language, title, text = match.groups()
            if language in languages:
                result.append(Block(page, language, title or "", text))
    return result


def commands() -> list[str]:
    """Return what the pages tell to type, without the name of the program."""
    pages = [block for block in blocks("sh") if block.page.name != SESSION]
    lines = [line for block in pages for line in block.text.splitlines()]
    starts = r"^(?:visnav|python -m runtime) (.*?)(?: +#.*)?$"
    return [match[1] for line in lines if (match := re.match(starts, line))]


def test_there_is_something_to_check() -> None:
    """The patterns above find what a reader sees."""
    assert len(PAGES) >= 20
    assert len(blocks("python")) >= 6
    assert len(blocks("toml")) >= 8
    assert len(commands()) >= 15


def test_every_block_says_its_language() -> None:
    known = {"python", "toml", "sh", "text", "json5", "xml", "cpp", "jinja", "yaml"}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        opened = re.findall(r"^```(.*)$", text, re.MULTILINE)[::2]
        assert {line.partition(" ")[0] for line in opened} <= known, page


@pytest.mark.parametrize(
    "block",
    [
        block
        for block in blocks("python")
        if ELSEWHERE not in block.text and block.page.name != SESSION
        if not block.title.startswith(PACKAGE)
    ],
    ids=str,
)
def test_python_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a module of its own: an assertion in it is one of ours."""
    module = types.ModuleType("snippet")
    monkeypatch.setitem(sys.modules, "snippet", module)
    monkeypatch.chdir(tmp_path)
    exec(compile(block.text, str(block), "exec"), vars(module))


@pytest.mark.parametrize("block", blocks("toml"), ids=str)
def test_toml_keeps_to_the_schema(block: Block) -> None:
    """Whole files and single tables; a part of a node's table is only read."""
    table = tomllib.loads(block.text)
    if block.title in ABOUT_FILES or not isinstance(table.get("nodes", []), list):
        return
    if block.title.startswith(PACKAGE):  # it has sensors that this schema knows nothing of
        return
    if set(table) <= {"run", "network", "nodes"}:
        whole = {"nodes": [{"name": "any", "type": "any:Any"}], **table}
        VALIDATOR.validate(whole)


def test_a_file_is_shown_as_it_is() -> None:
    """But for the schema's path, true in its folder only; pages are also read as plain files."""
    languages = ("python", "toml", "xml")
    shown = [
        candidate
        for candidate in blocks(*languages)
        if candidate.title
        and candidate.title not in ABOUT_FILES
        and (ROOT / candidate.title).is_file()
    ]
    assert len(shown) >= 5
    for block in shown:
        file = (ROOT / block.title).read_text(encoding="utf-8")
        assert block.text == re.sub(r"\A#:schema .*\n", "", file), block
    assert not [page for page in PAGES if "--8<--" in page.read_text(encoding="utf-8")]


@cache
def help_of(command: str) -> subprocess.CompletedProcess[str]:
    return command_here(command, "--help", folder=ROOT)


@pytest.mark.parametrize("words", sorted(set(commands())))
def test_commands_name_what_there_is(words: str) -> None:
    """The command exists, so do its files and options, and the settings that it changes."""
    name, *arguments = shlex.split(words)
    help_ = help_of(name)
    assert help_.returncode == 0, help_.stderr
    for option in (word for word in arguments if word.startswith("--")):
        assert option in help_.stdout, option
    pairs = list(itertools.pairwise(arguments))
    others = [value for option, value in pairs if option in {"--config", "--style"}]
    files = [word for word in arguments if word.endswith(".toml") and word not in others]
    changes = [value for option, value in pairs if option == "--set"]
    changes += [value.split(",")[0] for option, value in pairs if option == "--vary"]
    if name == "demo":
        files = ["config.toml"]
    if name == "suite":
        files = [read_suite(ROOT / file).rig for file in files]
    for file in files:
        settings = load(ROOT / file, changes)
        if "--only" in arguments:
            chosen(settings, arguments[arguments.index("--only") + 1])


def test_nodes_on_the_pages_exist() -> None:
    """Whatever a page names as a type of node can be put into a file."""
    named = {
        (page, name)
        for page in PAGES
        for name in re.findall(
            r"\b(?:nodes|sims)(?:\.\w+)+:[A-Z]\w+|(?<=type = \")[A-Z]\w+",
            page.read_text(encoding="utf-8"),
        )
    }
    assert len(named) >= 12
    points = tomllib.loads((ROOT / PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))
    for page, name in sorted(named):
        if name not in points["project"]["entry-points"]["visnav.nodes"]:
            find_node(name, str(page))


def test_files_on_the_pages_exist() -> None:
    """Paths in the project that a page names in code."""
    paths = r"`((?:examples|docs|tests|bench|runtime|nodes|sims)/[\w./-]+)`"
    for page in PAGES:
        for path in re.findall(paths, page.read_text(encoding="utf-8")):
            assert (ROOT / path).exists(), f"{page}: {path}"


@pytest.mark.slow
def test_the_bridge_of_the_page_steers_and_answers(tmp_path: Path) -> None:
    """In a run in real time: it takes velocities from UDP, and says where the vehicle is."""
    (bridge,) = (block for block in blocks("python") if block.title == "udp_bridge.py")
    (tmp_path / "udp_bridge.py").write_text(bridge.text, encoding="utf-8")
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "run.toml").write_text(
        f"""
        [run]
        clock = "real"
        [[nodes]]
        name = "drone"
        type = "Multirotor"
        [[nodes]]
        name = "udp"
        type = "udp_bridge:UdpBridge"
        port = {port}
        """
    )
    with (
        start(["run", "run.toml", "--out", "out", "--quiet"], tmp_path) as process,
        socket.socket(type=socket.SOCK_DGRAM) as client,
    ):
        client.settimeout(0.1)
        client.connect(("127.0.0.1", port))
        answer = b""
        while not answer and process.poll() is None:
            with contextlib.suppress(ConnectionRefusedError, TimeoutError):  # not yet there
                client.send(b"0.5 0 0")
                answer = client.recv(1024)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert len(answer.decode().split(",")) == 3
    assert summary(tmp_path / "out")["events"]["VelocitySetpoint"] >= 1


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_site_builds_and_needs_no_network(tmp_path: Path) -> None:
    """Strictly: every link leads somewhere; and no page loads anything from another server."""
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) >= 25
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|iframe)[^>]+src=\"([^\"]+)", text)
        loaded += re.findall(r"<link[^>]+rel=\"(?:stylesheet|preconnect|icon)\"[^>]*>", text)
        assert [tag for tag in loaded if "http" in tag.split("?")[0]] == [], page
    nodes = (tmp_path / "reference" / "nodes.html").read_text(encoding="utf-8")
    assert "VisualOdometry" in nodes
    assert "How many are tracked at most" not in nodes, "examples are no nodes of the project"
