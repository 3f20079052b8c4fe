"""Several runs in one figure, a sweep's plots, and the style of both."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest

from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.report.overlay import curves_of, draw_overlay, read_style, save
from nodes.judging.report.tables import drawing
from runtime.errors import CommandError, ConfigError, ResultsError
from runtime.tools.comparison import compare_values, read_slopes
from runtime.tools.comparison.flying import write_page
from tests.nodes.judging.report.folders import evaluated, recorded, summary, walk
from tests.runtime.tools.samples_cli import command_here
from tests.runtime.tools.sweep.samples import plan_in, pretend


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of one flight with two estimators, and one of another flight with one."""
    folder = tmp_path_factory.mktemp("runs")
    for name, seed, estimators in (
        ("a", 1, ("vo", "slam")),
        ("b", 1, ("vo", "slam")),
        ("c", 2, ("vo",)),
    ):
        (folder / name).mkdir()
        truth = walk(3, seed)
        records = {e: recorded(truth, rate=10, source=e, silent=(1.0, 2.0)) for e in estimators}
        summary(folder / name, evaluated(folder / name, truth, records, Thresholds()))
    return folder


def texts(path: Path) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text(encoding="utf-8"))


def lines_of(axes: Any) -> dict[str, Any]:
    return {line.get_label(): line for line in axes.get_lines()}


def test_runs_are_named_by_what_tells_them_apart(runs: Path, tmp_path: Path) -> None:
    a, b, c = runs / "a", runs / "b", runs / "c"
    assert [curve.name for curve in curves_of([a])] == ["vo", "slam"]
    assert [curve.name for curve in curves_of([a, c])] == ["a: vo", "a: slam", "c: vo"]
    assert [curve.name for curve in curves_of([a, b, c], ["vo"])] == ["a", "b", "c"]
    other = shutil.copytree(c, tmp_path / "c")
    assert [curve.name for curve in curves_of([c, other])] == [str(c), str(other)]
    with pytest.raises(CommandError, match="--estimator: expected one of vo, slam, found v0"):
        curves_of([a], ["v0"])


def test_a_flight_is_drawn_once_and_errors_over_time_and_distance(runs: Path) -> None:
    style = read_style(None)
    with drawing(style.settings()):
        figure = draw_overlay(
            curves_of([runs / n for n in "abc"]), ["above", "time", "distance"], style
        )
    above, time, distance = figure.axes
    assert [name for name in lines_of(above) if name.startswith("truth")] == ["truth", "truth 2"]
    assert len(above.get_lines()) == 2 + 5
    line = lines_of(time)["a: vo"]
    (errors,) = (c.estimator.image_errors for c in curves_of([runs / "a"], ["vo"]))
    assert errors is not None
    np.testing.assert_allclose(line.get_xdata(), errors.stamps / 1e9)
    assert np.isnan(line.get_ydata()).any()  # where it was lost
    truth = walk(3)
    x = lines_of(distance)["a: vo"].get_xdata()
    np.testing.assert_allclose(
        x[-1], truth.distances()[np.searchsorted(truth.stamps, errors.stamps[-1])], rtol=0.01
    )
    styles = {(line.get_color(), line.get_linestyle()) for line in above.get_lines()}
    assert len(styles) == 5 + 1


def test_text_stays_text_and_labels_are_replaced(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "style.toml").write_text(
        'size_mm = [88, 60]\nfont = "serif"\nfont_size = 7\ncolours = ["black", "#d55e00"]\n'
        'grid = false\n[labels]\n"a: vo" = "ours, β"\n"time (s)" = "t / s"\n',
        encoding="utf-8",
    )
    words = ("--panel", "time", "--style", "style.toml", "--out", "one.svg")
    done = command_here("plot", runs / "a", runs / "c", *words, folder=tmp_path)
    assert (done.returncode, done.stdout) == (0, "one.svg\n"), done.stderr
    assert {"ours, β", "a: slam", "c: vo", "t / s", "position error (m)"} <= {
        *texts(tmp_path / "one.svg")
    }
    text = (tmp_path / "one.svg").read_text(encoding="utf-8")
    assert 'width="249.448819pt"' in text  # 88 mm
    assert re.search("font-size: 7px; font-family: [^;]*serif", text)
    assert "#d55e00" in text


def test_who_is_far_astray_is_cut_off_and_equal_figures_give_equal_files(
    runs: Path, tmp_path: Path
) -> None:
    shutil.copytree(runs / "c", tmp_path / "c")
    path = tmp_path / "c" / "evaluation" / "vo.aligned.tum"
    *head, last = path.read_text().splitlines()
    stamp, _, rest = last.split(" ", 2)
    path.write_text("\n".join([*head, f"{stamp} 9e9 {rest}"]) + "\n")
    style = read_style(None)
    with drawing(style.settings()):
        for name in ("c.svg", "again.svg"):
            figure = draw_overlay(curves_of([tmp_path / "c"]), ["above"], style)
            save(figure, tmp_path / name, style)
    assert np.nanmax(lines_of(figure.axes[0])["vo"].get_ydata()) < 1e3
    assert (tmp_path / "c.svg").read_bytes() == (tmp_path / "again.svg").read_bytes()


@pytest.mark.slow  # fonts are cut to the letters that are used
def test_a_pdf_has_its_fonts_in_it_and_no_date(runs: Path, tmp_path: Path) -> None:
    for name in ("a.pdf", "b.pdf"):
        words = ("--panel", "time", "--out", name)
        assert command_here("plot", runs / "c", *words, folder=tmp_path).returncode == 0
    content = (tmp_path / "a.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/FontFile2" in content
    assert b"CreationDate" not in content
    assert (tmp_path / "b.pdf").read_bytes() == content


def test_a_sweep_has_a_plot_for_each_setting(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=5,6", "judge.limit=1,2", seeds=2)
    plan.out.mkdir()
    rows = b"".join(msgspec.json.encode(pretend(job)) + b"\n" for job in plan.jobs)
    (plan.out / "rows.jsonl").write_bytes(rows)
    (tmp_path / "style.toml").write_text('[labels]\n"judge.rate" = "rate (Hz)"\n')
    done = command_here("plot", "out", "--style", "style.toml", "--out", "s.svg", folder=tmp_path)
    assert done.stdout.split() == ["s_judge.rate.svg", "s_judge.limit.svg"], done.stderr
    assert "rate (Hz)" in texts(tmp_path / "s_judge.rate.svg")
    done = command_here("plot", "out", "out", folder=tmp_path)
    assert "expected runs, or one sweep" in done.stderr
    done = command_here("plot", "out", "--panel", "time", folder=tmp_path)
    assert "--panel: expected runs, found a folder of which all is plotted" in done.stderr


def test_a_comparison_is_plotted_as_its_page_draws_it(tmp_path: Path) -> None:
    flights = {("hall", seed): (0.2 + 0.01 * seed, None if seed > 1 else 0.1) for seed in range(8)}
    rows = [compare_values("vo", "ate_rmse_m", flights)]
    write_page(rows, tmp_path / "compared", ["old"], ["new"])
    assert math.isinf(rows[0].change)
    (slopes,) = read_slopes(tmp_path / "compared")
    assert (slopes.verdict, slopes.flights) == (rows[0].verdict, rows[0].flights)
    (tmp_path / "compared/rows.jsonl").touch()  # of its flights
    done = command_here("plot", "compared", "--out", "c.svg", folder=tmp_path)
    assert done.stdout.split() == ["c.svg"], done.stderr
    assert {"A", "B", "ate_rmse_m"} <= {*texts(tmp_path / "c.svg")}
    (tmp_path / "compared/compare.json").write_text("{")
    done = command_here("plot", "compared", "--out", "c.svg", folder=tmp_path)
    assert "compare.json: expected what compare writes, found" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "--out", "plot.jpg"], "--out plot.jpg: expected a file .svg or .pdf, found '.jpg'"),
        (["a", "--out", "no/plot.svg"], "--out no/plot.svg: expected a folder no, found none"),
        (["a", "--panel", "side"], "--panel: expected one of above, time, distance, found side"),
        (["none"], "none: expected the folder of a run"),
    ],
)
def test_what_is_wrong_is_said(words: list[str], message: str, runs: Path) -> None:
    done = command_here("plot", *words, folder=runs)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("size = 3", r"style\.toml: found unknown key 'size'"),
        ("size_mm = [0, 5]", r"size_mm"),
        ('colours = ["blu"]', r"expected colours such as #0072b2 or black, found 'blu'"),
        ("colours = []", r"expected a colour at least"),
        ("font_size = ", r"style\.toml: expected TOML"),
    ],
)
def test_a_wrong_style_is_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "style.toml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_style(tmp_path / "style.toml")


def test_a_font_that_is_not_here_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "style.toml").write_text('font = "No Such Font"')
    assert read_style(tmp_path / "style.toml").font == "No Such Font"
    assert "No Such Font is not on this machine" in capsys.readouterr().err


def test_a_run_without_estimators_is_refused(tmp_path: Path) -> None:
    summary(tmp_path)
    with pytest.raises(ResultsError, match="expected an estimator with poses, found: "):
        curves_of([tmp_path])


def test_the_report_writes_its_figures_in_other_formats(runs: Path) -> None:
    with mock.patch("nodes.judging.report.page.write_report", return_value="page") as write:
        assert command_here("report", "a", folder=runs).returncode == 0
        assert command_here("report", "a", "--format", "pdf", folder=runs).stdout == "page\n"
        done = command_here("report", "a", "--format", "jpg", folder=runs)
    assert [call.args[1] for call in write.call_args_list] == [("png", "svg"), ("png", "pdf")]
    assert "--format: expected png, svg or pdf, found jpg" in done.stderr
