"""What is read, and the sentence for each thing that cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hypothesis.strategies as st
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings

from nodes.judging import judgement
from nodes.judging.evaluation.judging import Judgement
from nodes.judging.mounting import read_mounting
from nodes.judging.readers import Source, of_body, read, read_truth
from nodes.judging.readers.stamps import read_stamps
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_euroc, write_kitti, write_tum
from tests.nodes.judging.judge import bags
from tests.nodes.judging.judge.test_judge import said
from tests.nodes.trajectory.samples import angle, moved, walk
from tests.nodes.trajectory.test_formats import assert_names, trajectories

LAB = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n"
GOOD = "0.0 0 0 0 0 0 0 1\n"


def write_lab(path: Path, trajectory: Trajectory) -> None:
    rows = [
        f"{stamp},{x!r},{y!r},{z!r},{i!r},{j!r},{k!r},{w!r}\n"
        for stamp, (x, y, z), (w, i, j, k) in trajectory.poses()
    ]
    path.write_text("".join([LAB, *rows]))


def write_all(path: Path, trajectory: Trajectory) -> None:
    """Write a KITTI file, and its stamps beside it."""
    write_kitti(path, trajectory)
    stamps = [f"{stamp // 10**9}.{stamp % 10**9:09d}\n" for stamp in trajectory.stamps.tolist()]
    path.with_name("times").write_text("".join(stamps))


FORMATS = (write_tum, write_euroc, write_lab, write_all)


@pytest.mark.parametrize("write", FORMATS)
@given(trajectory=trajectories())
@settings(max_examples=20, deadline=None)
def test_each_format_is_recognized_and_read_as_it_was_written(
    write: Callable[[Path, Trajectory], None], trajectory: Trajectory
) -> None:
    steps = np.concatenate([[0], np.clip(np.diff(trajectory.stamps), 10**6, 10**14)])
    first = max(int(trajectory.stamps[0]), 0)
    trajectory = Trajectory(first + np.cumsum(steps), trajectory.positions, trajectory.orientations)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "some.name"
        write(path, trajectory)
        source = read(str(path), "ned", str(Path(folder) / "times"))
    assert (source.name, source.file) == ("some", str(path))
    assert (source.poses.stamps == trajectory.stamps).all()
    assert abs(source.poses.positions - trajectory.positions).max() <= 0.6e-9
    assert angle(source.poses, trajectory) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("write", FORMATS)
@given(trajectory=trajectories(), data=st.data())
@settings(max_examples=30, deadline=None)
def test_damaged_files_are_errors_of_one_line(
    write: Callable[[Path, Trajectory], None], trajectory: Trajectory, data: st.DataObject
) -> None:
    """Cut anywhere, with any bytes changed."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        write(path, trajectory)
        content = bytearray(path.read_bytes())
        del content[data.draw(st.integers(0, len(content))) :]
        for place in data.draw(st.lists(st.integers(0, max(len(content) - 1, 0)), max_size=4)):
            content[place : place + 1] = bytes([data.draw(st.integers(0, 255))])
        path.write_bytes(content)
        wrong = ""
        try:
            read(str(path), None, str(Path(folder) / "times"))
        except ValueError as error:
            wrong = str(error)
        if wrong and not wrong.startswith(str(path.with_name("times"))):
            assert_names(wrong, path)


WRONG = [
    ("1 2 3\n", r"t:1: expected a trajectory: .* or of TUM \(8 fields.* found '1 2 3'"),
    ("# only\n", r"t: expected a trajectory: .*, found no rows"),
    ("7,1,2,3,1,0,0,0\n", r't:1: expected a trajectory: .* --columns "sec x y z qw qx qy qz", fou'),
    (GOOD + "1.0 0 x 0 0 0 0 1\n", r"t:2: expected finite numbers, found '0 x 0'"),
    (GOOD + "1.0 0 0 0 0 0 0\n", r"t:2: expected 8 fields, as in the first row, found '7: 1\.0"),
    (GOOD + "1 0 0 0 0 0 0 2\n", r"t:2: expected a quaternion of length 1"),
    (GOOD + "1 0 0 0 0 0 0 0\n", r"t:2: expected a quaternion of length 1"),
    (GOOD + "33333333 0 0 0 0 0 0 1\n", r"t: pose 2: expected stamps of one unit and one clock"),
    ("1e25 0 0 0 0 0 0 1\n", r"t:1: expected a stamp in seconds, found '1e25'"),
    ("1e999999 0 0 0 0 0 0 1\n", r"t:1: expected a stamp, found '1e999999'"),
    ("sec,nsec,x,y,z\n1e12,0,0,0,0\n", r"t:2: expected a stamp in 64 bits, found 1000000000000000"),
    (GOOD * 2000 + "\xff", r"t: expected a text file of rows, found: 'utf-8' codec can't decode"),
    ("nan 0 0 0 0 0 0 1\n", r"t: expected poses, found none: left out: 1 pose with NaN"),
    (LAB + "1.5,0,0,0,0,0,0,1\n", r"t:2: expected a stamp in whole nanoseconds, found '1\.5'"),
    (LAB + "1,0,0\n", r"t:2: expected a trajectory: .* found '1,0,0'"),
    ("t,x,y,z,qx,qy,qz\n1,0,0,0,0,0,0\n", r"t: expected four columns of a quaternion .* or none"),
    ("t,x,p_x,y,z\n1,0,0,0,0\n", r"t: expected one column of x .*, found \['x', 'p_x'\]"),
    ("a,b,c,d,e,f,g,h\n1,0,0,0,1,0,0,0,\n", r"t:2: expected a trajectory: .* header that names"),
    ("1 0 0 0 0 1 0 0 0 0 1 0\n", r"t: expected --times beside KITTI's poses"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("text", "message"), WRONG)
def test_each_bad_input_has_its_sentence(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "t").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=message):
        read(str(tmp_path / "t"))
    write_tum(tmp_path / "truth", walk(5))
    done = said(tmp_path, "--truth", "truth", "--estimate", "t")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("missing", ["--truth", "--estimate", "--frames"])
def test_a_file_that_is_not_there_is_named(missing: str, tmp_path: Path) -> None:
    write_tum(tmp_path / "t", walk(5))
    files = {"--truth": "t", "--estimate": "t", "--frames": "t"} | {missing: "nothing"}
    done = said(tmp_path, *(word for pair in files.items() for word in pair))
    assert (done.returncode, done.stderr) == (2, "error: nothing: No such file or directory\n")


@pytest.mark.parametrize("columns", ["", "sec x y z qx qy qz qw"])
def test_a_topic_of_a_file_is_refused(columns: str, tmp_path: Path) -> None:
    write_tum(tmp_path / "t", walk(5))
    with pytest.raises(
        ValueError, match=r"t: expected nothing after a file of one .*, found '/odom'"
    ):
        read(f"{tmp_path / 't'}:/odom", columns=columns)


def test_kittis_poses_and_stamps_are_as_many(tmp_path: Path) -> None:
    write_all(tmp_path / "k", walk(5))
    (tmp_path / "times").write_text("0\n1\n2\n")
    with pytest.raises(ValueError, match=r"k: expected 3 poses, as many as .*times has stamps, fo"):
        read(str(tmp_path / "k"), None, str(tmp_path / "times"))
    (tmp_path / "times").write_text("0\n1\n1\n2\n3\n")
    source = read(str(tmp_path / "k"), None, str(tmp_path / "times"))
    assert source.counts == {"repeated_stamps": 1}


@pytest.mark.parametrize(
    ("text", "stamps"),
    [
        ("0.0\n3.33e-2\n", [0, 33_300_000]),
        ("# timestamp filename\n1.5 rgb/1.5.png\n2 rgb/2.png\n", [1_500_000_000, 2_000_000_000]),
        ("#timestamp [ns],filename\n5,5.png\n7,7.png\n", [5, 7]),
        ("ts_rgb_0 (ns),path_rgb_0\n5,rgb_0/5.png\n7,rgb_0/7.png\n", [5, 7]),
    ],
)
def test_stamps_of_images_are_read_as_data_sets_have_them(
    text: str, stamps: list[int], tmp_path: Path
) -> None:
    (tmp_path / "t").write_text(text)
    assert read_stamps(tmp_path / "t").tolist() == stamps


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", r'--body-from-camera: expected "tx ty tz qx qy qz qw", a file \(TUM, Kalibr'),
        ("drone/front", r"--body-from-camera: expected .* found 'drone/front'"),
        ("0 0 0 0 0 0 x", r"--body-from-camera: expected finite numbers"),
        ("0 0 0 0 0 0 2", r"expected a quaternion of length 1, found \[2\.0, 0\.0, 0\.0, 0\.0\]"),
    ],
)
def test_a_mounting_that_is_none_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_mounting(text, "truth.tum")


def test_a_camera_that_the_run_has_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected 'drone/left' among the cameras on a body, fou"):
        read_mounting("drone/left", str(tmp_path))


MOUNTING = np.array([[0.0, 0, 1, 0.3], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("kinds", "note"),
    [
        ((), ()),
        (("velocities",), ("left out: velocities, which are of the camera's pose",)),
        (("covariances",), ("left out: covariances, which are of the camera's pose",)),
        (
            ("covariances", "velocities"),
            ("left out: covariances and velocities, which are of the camera's pose",),
        ),
    ],
)
def test_what_is_of_the_camera_only_is_left_out_with_a_note(
    kinds: tuple[str, ...], note: tuple[str, ...]
) -> None:
    values = {"velocities": np.ones((5, 3)), "covariances": np.ones((5, 6, 6))}
    camera: Source = msgspec.structs.replace(
        Source(name="vo", file="vo", poses=walk(5)), **{kind: values[kind] for kind in kinds}
    )
    body = of_body(camera, MOUNTING)
    assert (body.notes, body.velocities, body.covariances) == (note, None, None)


def test_a_lever_arm_needs_orientations(tmp_path: Path) -> None:
    """Without one, the camera's positions are the body's."""
    (tmp_path / "t").write_text("0.0 1 2 3\n0.1 2 3 4\n")
    with pytest.raises(ValueError, match=r"/t: expected orientations, .* found positions only"):
        read(str(tmp_path / "t"), camera=MOUNTING)
    turned = MOUNTING.copy()
    turned[:3, 3] = 0.0
    assert read(str(tmp_path / "t"), camera=turned).poses.positions.tolist()[1] == [2, 3, 4]


def judged(tmp_path: Path, truth: Trajectory, estimate: Trajectory, **settings: Any) -> Judgement:
    write_tum(tmp_path / "truth", truth)
    write_tum(tmp_path / "vo", estimate)
    true, source = read_truth(str(tmp_path / "truth"), ""), read(str(tmp_path / "vo"), None)
    config = judgement.JudgeConfig(**settings)
    _, judgements, _, _ = judgement.judge_all(true, [source], None, config)
    return judgements["vo"]


@pytest.mark.parametrize("axes", ["ned", "enu"])
@pytest.mark.parametrize("final", [False, True])
def test_a_camera_in_a_unit_of_its_own_is_judged_at_the_camera(
    tmp_path: Path, axes: Any, final: bool
) -> None:
    truth = walk(200)
    camera = moved(Trajectory.from_matrices(truth.stamps, truth.matrices() @ MOUNTING), 0.25)
    write_tum(tmp_path / "truth", truth)
    write_tum(tmp_path / "vo", camera)
    true = read_truth(str(tmp_path / "truth"), axes=axes)
    source = read(str(tmp_path / "vo"), camera=MOUNTING)
    config = judgement.JudgeConfig(scale_free=True)
    finals = {"vo": source} if final else {}
    _, judgements, _, _ = judgement.judge_all(true, [source], None, config, finals)
    figures = judgements["vo"].figures
    assert figures["scale"] == pytest.approx(4.0)
    assert figures["final_ate_rmse_m" if final else "ate_rmse_m"] < 1e-5


def test_no_time_in_common_fails_and_says_why(tmp_path: Path) -> None:
    truth = walk(50)
    later = Trajectory(truth.stamps + 10**18, truth.positions, truth.orientations)
    figures = judged(tmp_path, truth, later).figures
    assert "ate_rmse_m" not in figures
    assert "one is Unix time, the other counts from a beginning" in figures["why"]


def test_a_truth_too_sparse_to_judge_by_is_an_error(tmp_path: Path) -> None:
    truth = walk(100)
    ends = truth.take(np.array([0, 99]))
    with pytest.raises(ValueError, match=r"vo: .* true poses at most 0\.2 s apart, .*\(med"):
        judged(tmp_path, ends, truth.take(slice(10, 90)))


def test_two_estimates_of_one_name_need_another(tmp_path: Path) -> None:
    write_tum(tmp_path / "vo.tum", walk(5))
    one = read(str(tmp_path / "vo.tum"), None)
    with pytest.raises(ValueError, match=r"vo\.tum: expected a name of its own, NAME=/"):
        judgement.judge_all(one, [one, one], None, judgement.JudgeConfig())
    truth = read(f"truth={tmp_path / 'vo.tum'}", None)  # whose file it would overwrite
    with pytest.raises(ValueError, match="expected a name of its own"):
        judgement.judge_all(one, [truth], None, judgement.JudgeConfig())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--alignment", "so3"], "judge.alignment: expected"),
        (["--axes", "flu"], "judge.axes: expected"),
        (["--gap", "soon"], "judge.gap: expected a duration"),
        (["--threshold", "ate=1"], "judge.thresholds: found unknown key 'ate'"),
        (["--threshold", "ate_percent=low"], "judge.thresholds.ate_percent: expected"),
    ],
)
def test_wrong_options_are_named(words: list[str], message: str, tmp_path: Path) -> None:
    write_tum(tmp_path / "t", walk(5))
    done = said(tmp_path, "--truth", "t", "--estimate", "t", *words)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert message in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("topic", "change", "message"),
    [
        ("", None, r"bag: expected a topic of poses, as bag:/TOPIC, found ''; poses are on /slam"),
        ("/slam/pose", None, r"found '/slam/pose' \(did you mean '/slam/poses"),
        ("/rosout", None, r"bag: expected poses on /rosout, found std_msgs/msg/String; poses"),
        (
            "/slam/poses",
            (2.0, 0.0),
            r":/slam/poses: pose 3: expected a quaternion of length 1",
        ),
    ],
)
@pytest.mark.parametrize("type_", [bags.POSE, bags.PATH])
def test_a_bad_topic_has_its_sentence(
    topic: str, change: tuple[float, float] | None, message: str, type_: str, tmp_path: Path
) -> None:
    def wrong(number: int, message: Any) -> Any:
        if number == 3 and change is not None:
            turned, moved = change
            if turned != 1.0:
                message.pose.orientation.w += turned
            message.pose.position.x += moved
        return message

    bag = bags.bag(tmp_path / "bag", type_, walk(10), change=wrong)
    with pytest.raises(ValueError, match=message):
        read(f"{bag}:{topic}" if topic else str(bag), None)


def test_a_bag_that_is_cut_off_is_an_error_of_one_line(tmp_path: Path) -> None:
    bag = bags.bag(tmp_path / "bag", bags.POSE, walk(100))
    (file,) = bag.glob("*.mcap")
    data = file.read_bytes()
    for length in (0, 5, 100, len(data) // 2, len(data) - 5):
        file.write_bytes(data[:length])
        for where in (bag, file):
            with pytest.raises(ValueError, match=str(where)) as error:
                read(f"{where}:/slam/poses", None)
            assert "\n" not in str(error.value)
