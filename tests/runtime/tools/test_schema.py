"""The JSON schema: it is the one of the code, and takes what the runtime takes."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from events import Image
from runtime import Changeable, Duration, Input, Node, NodeConfig
from runtime.config.reading import find_nodes
from runtime.tools.describe import attribute_docs, schema

ROOT = Path(__file__).parents[3]
COMMITTED = ROOT / "docs" / "reference" / "config.schema.json"
VALIDATOR = jsonschema.Draft7Validator(json.loads(COMMITTED.read_text(encoding="utf-8")))
EXAMPLES = sorted([ROOT / "config.toml", *(ROOT / "examples").glob("*.toml")])


class PartConfig(NodeConfig):
    """A part.

    Attributes:
        name: Which one.
        share: How much of it
            there is.
    """

    name: str
    share: float = 0.5


class SampleConfig(NodeConfig):
    """Settings.

    Attributes:
        mode: How.
        gain: How much.
    """

    mode: str
    gain: Changeable[float] = 1.0
    wait: Duration | None = None
    parts: tuple[PartConfig, ...] = ()


class Sample(Node[SampleConfig]):
    """Does little. It is here

    for tests.
    """

    images = Input(Image)


def errors(table: dict[str, Any]) -> list[str]:
    """Return what the schema says against a node, given without its name and type."""
    made = schema({"tests:Sample": Sample})
    checker = jsonschema.Draft7Validator(made)
    node = {"name": "one", "type": "tests:Sample"} | table
    return [error.json_path for error in checker.iter_errors({"nodes": [node]})]


def test_the_committed_schema_is_that_of_the_code() -> None:
    made = json.loads(json.dumps(schema(find_nodes(print))))
    assert json.loads(COMMITTED.read_text(encoding="utf-8")) == made, (
        f"stale: python -m runtime schema --out {COMMITTED.relative_to(ROOT)}"
    )
    jsonschema.Draft7Validator.check_schema(made)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_names_the_schema_and_keeps_to_it(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    first = text.splitlines()[0]
    assert first.startswith("#:schema ")
    assert (path.parent / first.removeprefix("#:schema ")).resolve() == COMMITTED
    VALIDATOR.validate(tomllib.loads(text))


@pytest.mark.parametrize(
    "right",
    [
        {"mode": "a"},
        {"mode": "a", "gain": 2, "wait": "80 ms", "on_error": "drop"},
        {"mode": "a", "wait": 0.5, "parts": [{"name": "x"}], "inputs": {"images": "drone"}},
        {"mode": "a", "links": {"images": {"delay": "5ms", "loss": 0.5}}},
        {"type": "somebody:Else", "anything": 1},
    ],
)
def test_what_is_right_is_taken(right: dict[str, Any]) -> None:
    assert errors(right) == []


@pytest.mark.parametrize(
    ("wrong", "where"),
    [
        ({}, "$.nodes[0]"),
        ({"mode": 1}, "$.nodes[0].mode"),
        ({"mode": "a", "gian": 2.0}, "$.nodes[0]"),
        ({"mode": "a", "wait": "long"}, "$.nodes[0].wait"),
        ({"mode": "a", "parts": [{"share": 1.0}]}, "$.nodes[0].parts[0]"),
        ({"mode": "a", "inputs": {"imges": "drone"}}, "$.nodes[0].inputs"),
        ({"mode": "a", "links": {"images": {"loss": 2.0}}}, "$.nodes[0].links.images.loss"),
        ({"mode": "a", "on_error": "ignore"}, "$.nodes[0].on_error"),
        ({"mode": "a", "name": "run"}, "$.nodes[0].name"),
        ({"type": "no type"}, "$.nodes[0].type"),
    ],
)
def test_what_is_wrong_is_refused_where_it_stands(wrong: dict[str, Any], where: str) -> None:
    assert where in errors(wrong)


def test_descriptions_come_from_docstrings() -> None:
    assert attribute_docs(PartConfig) == {"name": "Which one.", "share": "How much of it there is."}
    definitions = schema({"tests:Sample": Sample})["$defs"]
    node = definitions["tests.Sample"]
    assert node["description"] == "Does little. It is here"
    assert node["properties"]["gain"] == {
        "type": "number",
        "default": 1.0,
        "description": "How much. It can be changed in a run.",
    }
