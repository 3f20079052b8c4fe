"""The page of figures names every figure and every threshold there is."""

from __future__ import annotations

import re
from pathlib import Path

from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.verdict import Thresholds
from tests.nodes.judging.report.folders import recorded, walk

PAGE = (Path(__file__).parents[4] / "docs" / "explanation" / "figures.md").read_text(
    encoding="utf-8"
)


def test_every_figure_and_threshold_is_explained() -> None:
    truth = walk(12)
    record = recorded(truth, silent=(5.0, 6.0), velocity=(1.0, 0.0, 0.0), covariance=(0.1,) * 36)
    record.final, record.final_frame_id = truth, "map"
    figures = {*judge(record, truth).figures} | {"plan_rmse_m", "plan_max_m", "collisions"}
    figures |= {"early_end", "ended_by", "reads_truth"}
    assert {"relocalization_p50_seconds", "nees_pose", "final_ate_percent"} <= figures
    explained = set(re.findall(r"`(\w+)`", PAGE))
    assert figures - {"method"} <= explained
    assert {*Thresholds.__struct_fields__} <= explained


def test_the_defaults_on_the_page_are_those_of_the_code() -> None:
    assert "`coverage_percent` at least 90;" in PAGE
    given = {name: getattr(Thresholds(), name) for name in Thresholds.__struct_fields__}
    assert {k: v for k, v in given.items() if v is not None} == {
        "coverage_percent": 90.0,
        "covariance_invalid": 0,
        "restarts": 0,
        "repeated_stamps": 0,
        "future_stamps": 0,
        "other_bodies": 0,
        "early_end": 0.0,
        "collisions": 0,
    }
