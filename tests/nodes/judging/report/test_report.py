"""The page of a run: what is on it, and that it needs nothing beside it; and its command."""

from __future__ import annotations

import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import runtime.tools.cli
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.report.folder import read_run
from nodes.judging.report.page import report, write_report
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_tum
from runtime.channels.answers import Answers, Settled
from runtime.errors import ConfigError
from runtime.summary import OutsideSummary
from tests.nodes.judging.report.folders import evaluated, frame, ply, recorded, summary, walk

LIMITS = Thresholds(ate_rmse_m=1e-4, lost_seconds=100.0)


class Page(HTMLParser):
    """What a reader sees, and what a browser would fetch."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.markup = path.read_text(encoding="utf-8")
        self.words: list[str] = []
        self.sources: list[str] = []
        self.tags: list[str] = []
        self.feed(self.markup)
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in {"src", "href"}]

    def handle_data(self, data: str) -> None:
        if self.tags[-1:] != ["style"]:
            self.words.append(data)


def lay_out(out: Path) -> None:
    """Make a run with all that the report knows of."""
    truth = walk(20)
    plan = Trajectory(truth.stamps[::40], truth.positions[::40], truth.orientations[::40])
    records = {
        "vo": recorded(truth, silent=(8.0, 10.5)),
        "slam/two": recorded(truth, noise=0.0005, source="slam/two"),
    }
    verdict = evaluated(out, truth, records, LIMITS, plan)
    summary(out, verdict)
    (out / "config.toml").write_text('[run]\nname = "sample"\n')
    (out / "log.txt").write_text(
        "    1.000000 INFO     vo: starting\n"
        "    8.000000 WARNING  vo: lost: too dark\n"
        "    9.000000 ERROR    drone: it failed\nTraceback: where\n"
        "   10.000000 INFO     vo: found again\n",
        encoding="utf-8",
    )
    for folder in ("frames", "clouds"):
        (out / folder).mkdir()
    for k in range(3):
        frame(out / "frames" / f"vo_{k * 1_500_000_000:015d}.jpg", k)
    random = np.random.default_rng(0)
    points = random.uniform((-4, -4, -2), (4, 4, 0), (5000, 3))
    ply(out / "clouds" / "truth.ply", points, random.integers(0, 255, (5000, 3)))
    ply(out / "clouds" / "vo.ply", points[:3000])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    lay_out(out)
    assert write_report(out, ("png",)) == out / "report.html"
    return out


@pytest.fixture(scope="module")
def page(run: Path) -> Page:
    return Page(run / "report.html")


@pytest.mark.slow
def test_the_figures_are_there_with_thresholds_and_what_was_missed(run: Path, page: Page) -> None:
    verdict = msgspec.json.decode((run / "evaluation" / "verdict.json").read_bytes())
    vo = verdict["estimators"]["vo"]
    assert f"{vo['ate_rmse_m']:.3g}" in page.text
    assert f"{vo['latency_p99_ms']:.3g}" in page.text
    assert "≤ 0.0001" in page.text
    assert vo["failed"][0] in page.text
    assert page.text.count("failed") >= 2
    assert 'missed">' in page.markup


@pytest.mark.slow
def test_every_section_and_fact_is_there(page: Page) -> None:
    for text in (
        "Trajectories", "Errors over time", "Position error along each axis",
        "Distribution of the errors", "Latency", "Relative error over path length", "Clouds",
        "Images and features of vo", "The run", "Warnings and errors",
        "What the estimators cost on this machine", "Punctuality of the ticks",
        "Machine and versions", "Settings (config.toml)",
        "20.00 s", "tour: tour flown", "0123456789abcdef (an equal run gives the same)",
        "dropped at vo.frames", "5 without depth", "11 lost, 4 left out", "431",
        "vo.make_tracker 80 600 6.1 9.7 131 5.9 8.8 77.7 123 1", "numpy", 'name = "sample"',
        "too dark", "Traceback: where",
    ):  # fmt: skip
        assert text in page.text
    for text in ("found again", "starting"):  # of the log, neither warnings nor errors
        assert text not in page.text
    assert re.search(r"Lost \(shaded\): vo (7\.9|8\.0)–10\.5 s\.", page.text)


def test_the_page_needs_nothing_beside_it(page: Page) -> None:
    assert len(page.sources) >= 8
    assert all(source.startswith("data:image/") for source in page.sources)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert "url(" not in page.markup
    assert "@import" not in page.markup


def test_every_image_is_one_and_shows_something(run: Path, page: Page) -> None:
    images = sorted((run / "plots").glob("*.png"))
    names = "axes clouds_1 distributions errors frames_vo latency relative trajectories"
    assert " ".join(p.stem for p in images) == names
    for path in images:
        image = cv2.imread(str(path))
        assert image is not None
        assert 600 < image.shape[1] <= 1110
        assert image.std() > 5
    assert page.markup.count("<img") == len(images)


@pytest.mark.slow
def test_of_two_vehicles_each_has_its_line_and_its_estimators(tmp_path: Path) -> None:
    first, second = walk(10), walk(10, seed=5)
    far = Trajectory(
        second.stamps, second.positions + np.array([2.0, 3.0, -1.0]), second.orientations
    )
    verdict = evaluated(tmp_path, far, {"vo": recorded(far)}, Thresholds())
    verdict["estimators"]["vo"]["vehicle"] = "other"
    trajectories = tmp_path / "trajectories"
    (trajectories / "truth.tum").rename(trajectories / "truth.other.tum")
    write_tum(trajectories / "truth.tum", first)
    place = ",".join(map(str, far.positions[1000]))
    (trajectories / "collisions.csv").write_text(f"head\n1,other,wall,{place},0.5\n")
    (tmp_path / "evaluation" / "verdict.json").write_bytes(msgspec.json.encode(verdict))
    announced = [
        {"type": "VehicleAnnouncement", "source": "drone"},
        {"type": "VehicleAnnouncement", "source": "other"},
        {
            "type": "BarometerAnnouncement", "source": "drone/barometer", "stamp": 0, "rate": 50.0,
            "latency": 0.0, "frame_id": "base_link", "noise": 3.0, "altitude": 122.0,
        },
        {
            "type": "CameraAnnouncement", "source": "other/eye", "rate": 30.0, "images": ["grey"],
            "info": {"width": 640, "height": 480, "distortion_model": "equidistant"},
        },
    ]  # fmt: skip
    summary(tmp_path, verdict, announcements=announced)
    page = Page(write_report(tmp_path, ("png",)))
    run = read_run(tmp_path)
    assert list(run.truths) == ["drone", "other"]
    (vo,) = run.estimators
    assert run.truth_of(vo) is run.truths["other"]
    for text in (
        "of other; laid on the truth at its first pose",
        "true path of drone",
        "true path of other",
        "drone/barometer Barometer 50 noise 3, altitude 122",
        "other/eye Camera 30 640 × 480, equidistant, images grey",
    ):
        assert text in page.text
    assert len(run.collisions) == 1
    assert (tmp_path / "plots" / "relative.png").exists()


@pytest.mark.slow
def test_the_same_run_gives_the_same_bytes(run: Path, tmp_path: Path) -> None:
    again = tmp_path / run.name
    shutil.copytree(run, again)
    write_report(again)
    before = {p: p.read_bytes() for p in again.rglob("*") if p.is_file()}
    (again / "plots" / "clouds_9.png").touch()  # of an earlier report with more clouds
    write_report(again)
    assert {p: p.read_bytes() for p in again.rglob("*") if p.is_file()} == before


@pytest.mark.slow
def test_hostile_names_are_shown_as_they_are(tmp_path: Path) -> None:
    """Markup stays text, and neither formulas nor a leading underscore trouble the legends."""
    truth, name = walk(3), "_<script>alert('$x^{$')</script>&飛"
    (tmp_path / "trajectories").mkdir()
    shown = evaluated(tmp_path, truth, {"_$a^{$": recorded(truth)}, Thresholds())
    figures = {"passed": False, "failed": ["<b>bold</b>"], "method": "<i>m</i>", "<u>": "<s>"}
    shown["estimators"][name] = figures
    (tmp_path / "evaluation" / "verdict.json").write_bytes(msgspec.json.encode(shown))
    summary(tmp_path, shown, name="<h6>", reason="<marquee>", error="<blink>")
    (tmp_path / "config.toml").write_text("</pre><h5>")
    (tmp_path / "log.txt").write_text("    1.000000 ERROR    a: </pre><h4>\n")
    page = Page(write_report(tmp_path, ("png",)))
    assert not {"script", "b", "i", "u", "s", "h6", "marquee", "blink", "h5", "h4"} & set(page.tags)
    for text in (name, "<b>bold</b>", "<i>m</i>", "<marquee>", "</pre><h5>"):
        assert text in page.text


def test_a_system_that_lost_frames_is_told_at_the_top_and_in_a_table(tmp_path: Path) -> None:
    answers = Answers(latency=0.015)
    for stamp in range(3):
        answers.owed(stamp)
        answers.record_input("images", bytes([stamp]))
        answers.settled(Settled(stamp, stamp, "lost" if stamp == 1 else "answered", 0.004))
    answers.why_not["frames were lost after 10 s of real time"] = None
    truth = walk(2)
    verdict = evaluated(tmp_path, truth, {"slam": recorded(truth)}, Thresholds(), truth)
    summary(tmp_path, verdict)
    written = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    lost = {"passed": False, "failed": ["lost_frames: expected at most 0, found 1"]}
    written["verdict"]["estimators"]["slam (answers)"] = lost
    written["outside"] = {"slam": msgspec.to_builtins(OutsideSummary.of(answers))}
    written["not_deterministic"] = ["slam"]
    (tmp_path / "summary.json").write_bytes(msgspec.json.encode(written))
    page = Page(write_report(tmp_path, formats=()))
    assert "failed slam (answers) lost_frames: expected at most 0, found 1" in page.text
    assert "slam 3 – 2 0 0 0 1 0 0 0 0 0 0 0 15 4" in page.text
    assert "no: frames were lost after 10 s of real time" in page.text
    assert f"digest of what slam was sent {answers.inputs()}" in page.text


app = typer.Typer()
app.command()(report)


def test_it_prints_the_pages_path(tmp_path: Path) -> None:
    summary(tmp_path)
    done = CliRunner().invoke(app, [str(tmp_path)], catch_exceptions=False)
    assert done.output.splitlines() == [str(tmp_path / "report.html")]


def test_what_cannot_be_written_is_one_of_our_errors(tmp_path: Path) -> None:
    summary(tmp_path)
    (tmp_path / "plots").touch()
    with pytest.raises(ConfigError, match=r"plots"):
        CliRunner().invoke(app, [str(tmp_path)], catch_exceptions=False, standalone_mode=False)


def test_a_folder_that_is_no_run_gives_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["runtime", "report", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runtime.tools.cli.main()
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"error: {tmp_path}: expected the folder of a run")
    assert said.err.count("\n") == 1
