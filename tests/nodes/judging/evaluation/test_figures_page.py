"""The table of figures has every figure and every threshold there is, and the pages show it."""

from __future__ import annotations

import re
from pathlib import Path

from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.thresholds import Thresholds
from runtime.figures import FIGURES, IN_SWEEPS, figure
from tests.nodes.judging.report.folders import recorded, walk

PAGE = (Path(__file__).parents[4] / "docs" / "explanation" / "figures.md").read_text(
    encoding="utf-8"
)


def test_every_figure_is_in_the_table_and_on_the_page() -> None:
    truth = walk(12)
    record = recorded(truth, silent=(5.0, 6.0), velocity=(1.0, 0.0, 0.0), covariance=(0.1,) * 36)
    record.final, record.final_frame_id = truth, "map"
    figures = {*judge(record, truth).figures} | {"plan_rmse_m", "plan_max_m", "collisions"}
    figures |= {"early_end_seconds", "ended_by", "reads_truth", "commands"}
    figures |= {"camera", "stamped_at_images_percent"}
    assert {"relocalization_p50_seconds", "nees_pose", "final_ate_percent"} <= figures
    assert figures <= {*FIGURES}
    assert "<!-- all figures" in PAGE  # `tools.docs_pages` puts the table there


def test_thresholds_are_those_of_the_table_with_the_defaults_that_the_page_names() -> None:
    asked = [entry for entry in FIGURES.values() if entry.limit]
    assert list(Thresholds.__struct_fields__) == [entry.name for entry in asked]
    assert [getattr(Thresholds(), entry.name) for entry in asked] == [e.default for e in asked]
    assert "`coverage_percent` at least 90;" in PAGE
    counts = {entry.name for entry in asked if entry.default == 0}
    (sentence,) = re.findall(r"at least 90;(.*?)at most 0;", PAGE, re.DOTALL)
    assert {*re.findall(r"`(\w+)`", sentence)} == counts
    assert FIGURES["velocities_percent"].all_or_none == 95.0
    table = PAGE.partition("### Defaults")[2].partition("## How the run ended")[0]
    for entry in asked:
        if entry.default and entry.name not in {"coverage_percent", "compared_percent"}:
            assert f"| `{entry.name}` | at {entry.limit} {entry.default:g} |" in table


def test_units_are_the_ends_of_names_and_an_unknown_figure_has_words() -> None:
    assert {entry.name for entry in FIGURES.values() if not entry.unit} >= {"restarts", "nees_pose"}
    assert (figure("late_p50_ms").unit, figure("late_p50_ms").meaning) == ("ms", "late p50 ms")
    assert len(IN_SWEEPS) == len({*IN_SWEEPS}) == max(entry.sweep for entry in FIGURES.values())
