"""An infinite threshold is none: for all estimators or one, and also where there is a default."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from nodes.judging.evaluation.node import EvaluationConfig
from nodes.judging.evaluation.thresholds import Thresholds
from runtime.config.reading import load
from runtime.errors import ConfigError
from runtime.figures import FIGURES

EVALUATION = """
[[nodes]]
name = "evaluation"
type = "Evaluation"
thresholds = { ate_percent = inf, coverage_percent = -inf, repeated_stamps = inf }

[nodes.estimators.odometry.thresholds]
frame_coverage_percent = inf
"""


def evaluation(folder: Path, text: str) -> EvaluationConfig:
    """Read the settings of a file with an evaluation."""
    path = folder / "c.toml"
    path.write_text(text, encoding="utf-8")
    (spec,) = load(path).nodes
    assert isinstance(spec.config, EvaluationConfig)
    return spec.config


def test_a_file_may_have_infinite_thresholds(tmp_path: Path) -> None:
    config = evaluation(tmp_path, EVALUATION)
    assert config.thresholds.ate_percent == math.inf  # type: ignore[attr-defined]
    assert config.thresholds.repeated_stamps == math.inf  # type: ignore[attr-defined]
    own = config.own_thresholds()["odometry"]
    assert own.frame_coverage_percent == math.inf  # type: ignore[attr-defined]
    assert not config.thresholds.any_set()
    for wrong, expected in (
        ("thresholds = { ate_percent = nan }", "expected a finite number"),
        ("gap = inf", "expected a finite number"),
        ("align_first = 0", "expected a whole number >= 1"),
        ("align_first = '5 parsec'", "align_first: expected a number of poses or a duration: "),
    ):
        with pytest.raises(ConfigError, match=expected):
            evaluation(tmp_path, f"[[nodes]]\nname = 'e'\ntype = 'Evaluation'\n{wrong}\n")


@pytest.mark.parametrize("limit", [math.inf, -math.inf])
@pytest.mark.parametrize("name", [figure.name for figure in FIGURES.values() if figure.limit])
@pytest.mark.parametrize("value", [None, 0.0, 1e9])
def test_no_value_and_no_missing_figure_misses_an_infinite_threshold(
    name: str, limit: float, value: float | None
) -> None:
    assert FIGURES[name].missed(limit, value) == ""


def test_infinite_thresholds_turn_defaults_off() -> None:
    figures = {"coverage_percent": 10.0, "ate_percent": 99.0, "repeated_stamps": 3}
    names = {"coverage_percent", "repeated_stamps"}
    asked = Thresholds()
    assert names <= {text.partition(":")[0] for text in asked.missed(figures)}
    off = Thresholds(ate_percent=math.inf, **dict.fromkeys(names, math.inf))
    assert not names & {text.partition(":")[0] for text in off.missed(figures)}
    assert not off.any_set()
