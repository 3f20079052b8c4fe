"""One trajectory in many containers: each is read as what it is, whatever it looks like."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from nodes.judging import judgement
from nodes.judging.evaluation.judging import Judgement
from nodes.judging.readers import read, read_truth, readers
from nodes.judging.readers.columns import column_of, columns_of
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_euroc, write_kitti, write_tum
from tests.nodes.judging.judge import bags
from tests.nodes.trajectory.samples import angle, walk
from visnav_airsim.server.measurements import HEADER

START = 1_700_000_000_000_000_000
POSE = walk(60, start=START)
NUMBERS = {
    **dict(zip("xyz", POSE.positions.T, strict=True)),
    **dict(zip(("qw", "qx", "qy", "qz"), POSE.orientations.T, strict=True)),
}
OKVIS = (
    "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x, v_WS_W_y, "
    "v_WS_W_z, b_g_x, b_g_y, b_g_z, b_a_x, b_a_y, b_a_z"
)
TUM_VI = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], " + (
    "q_RS_y [], q_RS_z []"
)
ECHO = "%time,field.header.seq,field.header.stamp,field.header.frame_id," + ",".join(
    f"field.pose.pose.{name}.{axis}"
    for name, axes in (("position", "xyz"), ("orientation", "xyzw"))
    for axis in axes
)


def seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def rows(stamp: Callable[[int], str], kinds: str, separator: str, end: str = "") -> str:
    """Return the rows of the trajectory; kinds that are no column of it are written as they are."""
    text = ""
    for number, time in enumerate(POSE.stamps.tolist()):
        fields = [repr(float(NUMBERS[k][number])) if k in NUMBERS else k for k in kinds.split()]
        text += separator.join([stamp(time), *fields]) + end + "\n"
    return text


XYZW, WXYZ = "x y z qx qy qz qw", "x y z qw qx qy qz"
STATES = "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans etc\n"
AIRSIM = f"{HEADER}\n"  # of our own recordings
COVARIANCE = "1e-4 0 0 1e-4 0 1e-4 1e-2 0 0 1e-2 0 1e-2"
TABLES = {
    "TUM": "# timestamp tx ty tz qx qy qz qw\n" + rows(seconds, XYZW, " "),
    "TUM without a header": rows(seconds, XYZW, " "),
    "TUM, tabs": rows(seconds, XYZW, "\t"),
    "TUM, nanoseconds": rows(lambda t: f"{t}.000000", XYZW, " "),
    "TUM, scalar first by its header": "# time x y z qw qx qy qz\n" + rows(seconds, WXYZ, " "),
    "EuRoC without a header": rows(str, WXYZ + " 0 0 0 0 0 0 0 0 0", ","),
    "TUM VI": TUM_VI + "\n" + rows(str, WXYZ, ","),
    "OKVIS2": OKVIS + "\n" + rows(str, XYZW + " 0 0 0 0 0 0 0 0 0", ", "),
    "OKVIS2, a comment": "#" + OKVIS + "\n" + rows(str, XYZW + " 0 0 0 0 0 0 0 0 0", ", "),
    "VINS-Fusion": rows(str, WXYZ + " 0 0 0", ",", ","),
    "VINS-Mono after loops": rows(str, WXYZ, ",", ","),
    "VSLAM-LAB": "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n" + rows(str, XYZW, ","),
    "OpenVINS": rows(seconds, f"{XYZW} {COVARIANCE}", " "),
    "OpenVINS, states": STATES + rows(seconds, "qx qy qz qw x y z 0 0 0 0 0 0 0 0 0 0 1", " "),
    "evalio": "# name: x\n# timestamp, x, y, z, qx, qy, qz, qw\n" + rows(seconds, XYZW, ", "),
    "MCD": "num,t,x,y,z,qx,qy,qz,qw\n" + rows(lambda t: f"7,{seconds(t)}", XYZW, ","),
    "rostopic echo -p": ECHO + "\n" + rows(lambda t: f"{t + 5},1,{t}", "odom " + XYZW, ","),
    "seconds and nanoseconds": "sec,nsec,x,y,z,qx,qy,qz,qw\n"
    + rows(lambda t: f"{t // 10**9},{t % 10**9}", XYZW, ","),
    "semicolons": "time [us]; x; y; z; qx; qy; qz; qw\n"
    + rows(lambda t: f"{t // 1000}", XYZW, ";"),
    "microseconds by their size": "timestamp,x,y,z,qw,qx,qy,qz\n"
    + rows(lambda t: f"{t // 1000}", WXYZ, ","),
    "AirSim": AIRSIM + rows(lambda t: f"Drone1\t{t // 10**6}", WXYZ + " a.png;b.png", "\t"),
    "AirSim without images": AIRSIM + rows(lambda t: f"Drone1\t{t // 10**6}", WXYZ, "\t", "\t"),
    "transforms with stamps": "".join(
        f"{seconds(t)} {' '.join(map(repr, matrix[:3].ravel().tolist()))}\n"
        for t, matrix in zip(POSE.stamps.tolist(), POSE.matrices(), strict=True)
    ),
}


@pytest.mark.parametrize("name", TABLES)
def test_each_format_is_the_same_trajectory(name: str, tmp_path: Path) -> None:
    (tmp_path / "t").write_text(TABLES[name])
    source = read(str(tmp_path / "t"))
    assert source.poses.stamps.tolist() == POSE.stamps.tolist()
    assert source.poses.positions == pytest.approx(POSE.positions, abs=1e-12)
    assert angle(source.poses, POSE) < 1e-9
    assert (source.counts, source.notes, source.positions_only) == ({}, (), False)
    assert (source.axes.world == "ned") == name.startswith("AirSim")


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ("sec x y z qw qx qy qz", rows(seconds, WXYZ, " ")),
        ("ns,x,y,z,qw,qx,qy,qz", rows(str, WXYZ, ",")),
        ("us qz qy qx qw z y x", rows(lambda t: f"{t // 1000}", "qz qy qx qw z y x", ";")),
        ("_ ms x y z _ qx qy qz qw", rows(lambda t: f"a,{t // 10**6}", "x y z b " + XYZW[6:], ",")),
    ],
)
def test_columns_are_the_users_words(columns: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "t").write_text(text)
    source = read(str(tmp_path / "t"), columns=columns)
    assert source.poses.stamps.tolist() == POSE.stamps.tolist()
    assert angle(source.poses, POSE) < 1e-9
    assert source.poses.positions == pytest.approx(POSE.positions)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("name", ["TUM without a header", "EuRoC without a header", "VINS-Fusion"])
def test_a_comment_after_a_row_is_none_of_it(name: str, number: int, tmp_path: Path) -> None:
    lines = TABLES[name].splitlines()
    lines[number] += "  # 1 of 60"
    (tmp_path / "t").write_text("\n".join(lines) + "\n")
    source = read(str(tmp_path / "t"))
    assert source.poses.stamps.tolist() == POSE.stamps.tolist()
    assert source.poses.positions == pytest.approx(POSE.positions, abs=1e-12)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            "sec x y",
            r'--columns: expected a stamp and x y z among them, as "sec x y z qw qx qy qz"',
        ),
        ("sec x y z w", r"--columns: expected names as sec .*, found 'w'"),
        ("sec x y z qw", r"expected four columns of a quaternion .* or none .*, found qw"),
        ("sec x y z q0 q1 q2 q3", r"--columns: expected names as sec .*, found 'q0'"),
        ("sec x y z x", r"expected one column of x .*, found \['x', 'x'\]"),
        ("sec x y z _ _ _ _ _ _ vx vx", r"--columns: expected names as sec .*, found 'vx'"),
        ("sec x y z _ _ _ _ _", r"t:1: expected 9 fields, as --columns says, found 8: "),
    ],
)
def test_columns_that_are_none_are_refused(columns: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "t").write_text(rows(seconds, WXYZ, " "))
    with pytest.raises(ValueError, match=message):
        read(str(tmp_path / "t"), columns=columns)


SPELLINGS = {
    "t": ("timestamp", "#timestamp [ns]", "t", "ts (ns)", "time", "stamp", "timestamp_ns"),
    "x": ("x", "tx", "px", "p_x", "p_RS_R_x [m]", "POS_X", "pos_x", "pose.position.x"),
    "qw": ("qw", "q_w", "q_RS_w []", "Q_W", "pose.orientation.w", "quat_w", "q_WS_w"),
    "skip": ("v", "bx", "b_a_x [m s^-2]", "ax", "w_x", "frame_id", "roll", "status", "vx"),
}


@pytest.mark.slow
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_columns_are_found_in_any_order_by_any_name(data: st.DataObject) -> None:
    """With other columns between, and any separator."""
    separator = data.draw(st.sampled_from([",", ", ", ";", "\t"]))
    spelling = {
        k: data.draw(st.sampled_from(names)) for k, names in SPELLINGS.items() if k != "skip"
    }
    kinds = ["t", "x", "y", "z", "qw", "qx", "qy", "qz"]
    kinds += [f"skip{k}" for k in range(data.draw(st.integers(0, 5)))]
    kinds = data.draw(st.permutations(kinds))

    def name(kind: str) -> str:
        if kind.startswith("skip"):
            return SPELLINGS["skip"][int(kind[4:])]
        if kind == "t":
            return spelling["t"].lstrip("#")
        model, letter = ("qw", "w") if kind.startswith("q") else ("x", "x")
        head, letters, tail = spelling[model].rpartition(letter)
        if not letters:
            head, _, tail = spelling[model].rpartition(letter.upper())
        return f"{head}{kind[-1]}{tail}"

    head = data.draw(st.sampled_from(["", "#", "# "])) + separator.join(map(name, kinds)) + "\n"
    body = ""
    for number, stamp in enumerate(POSE.stamps.tolist()):
        values = {k: repr(float(column[number])) for k, column in NUMBERS.items()}
        values["t"] = str(stamp)
        body += separator.join(values.get(kind, "5") for kind in kinds) + "\n"
    with TemporaryDirectory() as folder:
        (Path(folder) / "t").write_text(head + body)
        source = read(str(Path(folder) / "t"))
    assert (source.poses.stamps == POSE.stamps).all()
    assert (source.poses.positions == POSE.positions).all()
    assert angle(source.poses, POSE) < 1e-9


@pytest.mark.parametrize("name", ["v", "b_w_RS_S_x", "ax", "w_x", "num", "dt", "q", "vx", "p", ""])
def test_other_columns_are_left_alone(name: str) -> None:
    assert column_of(name).kind == ""


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("t,x,y,z,q0,q1,q2,q3", r"with w, x, y, z in their names, .*, found q0, q1, q2, q3"),
        ("t,x,y,z,i,j,k,w", r"four columns of a quaternion .*, found i, j, k, w"),
        ("t,x,y,z,rx,ry,rz,rw", r"four columns of a quaternion .*, found rw"),
        ("t,x,y,z,qx,qy,qz,q", r"four columns of a quaternion .*, found qx, qy, qz"),
    ],
)
def test_a_quaternion_whose_order_is_not_named_is_refused(
    header: str, message: str, tmp_path: Path
) -> None:
    """Rather than that the file is taken for one of positions only."""
    (tmp_path / "t").write_text(header + "\n" + rows(str, WXYZ, ","))
    with pytest.raises(ValueError, match=message):
        read(str(tmp_path / "t"))


@pytest.mark.parametrize("header", [False, True])
@pytest.mark.parametrize("columns", ["", "sec x y z qx qy qz qw"])
@pytest.mark.parametrize("separator", [";", "; ", "\t", " "])
def test_a_decimal_comma_is_named(
    separator: str, columns: str, header: bool, tmp_path: Path
) -> None:
    """Also after a first row of whole numbers."""
    text = rows(seconds, XYZW, separator).replace(".", ",")
    zeros = separator.join("0" * 7 + "1") + "\n"
    names = separator.join(["t", *XYZW.split()]) + "\n"
    for lines in (text, zeros + text) if header or columns else (text,):
        (tmp_path / "t").write_text(names * header + lines)
        with pytest.raises(ValueError, match=r"/t:\d: expected .*with a decimal point, not with a"):
            read(str(tmp_path / "t"), columns=columns)


def test_a_decimal_comma_of_transforms_is_named(tmp_path: Path) -> None:
    (tmp_path / "t").write_text("1,5 0,0 0,0 0,0 0,0 1,0 0,0 0,0 0,0 0,0 1,0 0,0\n")
    with pytest.raises(ValueError, match=r"/t:1: expected numbers with a decimal point, not with"):
        read(str(tmp_path / "t"))


def with_names(name: Callable[[int], str], header: str, separator: str) -> str:
    """Return a table of positions whose rows begin with a name, of their number."""
    lines = rows(seconds, "x y z", separator).splitlines()
    return f"{header}\n" + "".join(
        f"{name(number)}{separator}{line}\n" for number, line in enumerate(lines)
    )


ROWS_WITH_NAMES = {
    "pandas, tabs": with_names(str, "\ttimestamp\tx\ty\tz", "\t"),
    "pandas, commas": with_names(str, ",timestamp,x,y,z", ","),
    "tabs, an empty label": with_names(lambda k: "", "label\ttimestamp\tx\ty\tz", "\t"),
    "tabs, a label of some": with_names("a".__mul__, "label\ttimestamp\tx\ty\tz", "\t"),
    "tabs, a comment's sign": with_names(str, "# \ttimestamp\tx\ty\tz", "\t"),
    "tabs, a sign in its own field": "#\tt\tx\ty\tz\n" + rows(seconds, "x y z", "\t"),
    "tabs, a remark of some": "t\tx\ty\tz\tremark\n"
    + rows(seconds, "x y z", "\t", "\t").replace("\t\n", "\tgood\n", 9),
    "R, blanks": with_names(lambda k: f'"{k + 1}"', '"timestamp" "x" "y" "z"', " "),
    "R, tabs": with_names(lambda k: f'"{k + 1}"', '"timestamp"\t"x"\t"y"\t"z"', "\t"),
    "R, commas, no quotes": with_names(lambda k: f"{k + 1}", "timestamp,x,y,z", ","),
    "R, tabs, no quotes": with_names(lambda k: f"{k + 1}", "timestamp\tx\ty\tz", "\t"),
}


@pytest.mark.parametrize("name", ROWS_WITH_NAMES)
def test_columns_stand_under_their_names(name: str, tmp_path: Path) -> None:
    (tmp_path / "t").write_text(ROWS_WITH_NAMES[name])
    source = read(str(tmp_path / "t"))
    assert source.poses.stamps.tolist() == POSE.stamps.tolist()
    assert source.poses.positions == pytest.approx(POSE.positions, abs=1e-12)


@pytest.mark.parametrize("separator", ["\t", " ", ",", ";"])
def test_a_name_less_than_fields_is_refused_unless_it_is_clear_which(
    separator: str, tmp_path: Path
) -> None:
    """A first field of 1, 2, 3, … may be a stamp in seconds."""
    text = separator.join(["timestamp", "x", "y", "z"]) + "\n"
    text += "".join(separator.join([f"{k}", f"{k / 10}", "4", "5", "6"]) + "\n" for k in (1, 2, 3))
    (tmp_path / "t").write_text(text)
    message = r"/t: expected a name for each of 5 fields, found 4 names: .* --columns \"_ sec x y z"
    with pytest.raises(ValueError, match=message):
        read(str(tmp_path / "t"))
    source = read(str(tmp_path / "t"), columns="_ sec x y z")
    assert source.poses.stamps.tolist() == [100_000_000, 200_000_000, 300_000_000]
    assert source.poses.positions.tolist() == [[4, 5, 6]] * 3


def test_a_row_between_tabs_lacks_its_last_field_at_most(tmp_path: Path) -> None:
    (tmp_path / "t").write_text("t\tx\ty\tz\ta\tb\n0.5\t1\t2\t3\t4\t5\n0.6\t1\t2\t3\n")
    with pytest.raises(ValueError, match=r"/t:3: expected 6 fields, as in the first row, found '4"):
        read(str(tmp_path / "t"))


@pytest.mark.parametrize(
    ("header", "metres"),
    [
        ("timestamp [s],x [mm],y [mm],z [mm]", (1e-3, 1e-3, 1e-3)),
        ("time (s),x (cm),y (cm),z (cm)", (0.01, 0.01, 0.01)),
        ("t;p_RS_R_x [km];p_RS_R_y [km];p_RS_R_z [km]", (1e3, 1e3, 1e3)),
        ("# t x [um] y [µm] z [micrometers]", (1e-6, 1e-6, 1e-6)),
        ("t x [dm] y [nm] z [m]", (0.1, 1e-9, 1.0)),
        ("# t[s] tx ty tz[mm]", (1e-3, 1e-3, 1e-3)),
        ("t,x [world] [mm],y [world] [mm],z [world] [mm]", (1e-3, 1e-3, 1e-3)),
        ("t,x [],y [],z []", (1.0, 1.0, 1.0)),
    ],
)
@pytest.mark.parametrize("by_user", [False, True])
def test_positions_are_metres_whatever_their_unit(
    header: str, metres: tuple[float, float, float], by_user: bool, tmp_path: Path
) -> None:
    separator = next((s for s in ",;" if s in header), " ")
    names = header.lstrip("# ").replace(" [", "[").replace(" (", "(")
    (tmp_path / "t").write_text(
        ("" if by_user else header + "\n")
        + "".join(separator.join([f"{time}.5", "1", "2", "-3"]) + "\n" for time in range(3))
    )
    source = read(str(tmp_path / "t"), columns=names if by_user else "")
    assert source.poses.positions[0] == pytest.approx(np.array([1, 2, -3]) * metres, rel=1e-12)
    assert source.poses.stamps.tolist() == [500_000_000, 1_500_000_000, 2_500_000_000]


@pytest.mark.parametrize(
    ("unit", "scale"),
    [("m s^-1", 1), ("mm/s", 1e-3), ("mm s^-1", 1e-3), ("cm·s⁻¹", 0.01), ("km/sec", 1e3), ("", 1)],
)
def test_velocities_are_metres_per_second(unit: str, scale: float, tmp_path: Path) -> None:
    names = ",".join(f"v_RS_R_{axis} [{unit}]" for axis in "xyz")
    (tmp_path / "t").write_text(f"t [s],x,y,z,{names}\n0.5,0,0,0,1,2,3\n1.5,0,0,0,1,2,3\n")
    source = read(str(tmp_path / "t"))
    assert source.velocities is not None
    assert source.velocities[1] == pytest.approx(np.array([1, 2, 3]) * scale, rel=1e-12)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("t [min],x,y,z", r"/t: expected the unit of 't' among s, ms, us, ns .*'min'"),
        ("t,x,y [ft],z", r"/t: expected the unit of 'y' among m, dm, .* km .*, found 'ft'"),
        (
            "t,x,y,z,v_RS_R_x [km/h],v_RS_R_y [km/h],v_RS_R_z [km/h]",
            r"the unit of 'v_RS_R_x' among m, .* km per second .*, found 'km/h'",
        ),
    ],
)
def test_an_unknown_unit_is_refused(header: str, message: str, tmp_path: Path) -> None:
    row = ",".join(["0.5"] * len(header.split(",")))
    (tmp_path / "t").write_text(f"{header}\n{row}\n")
    with pytest.raises(ValueError, match=message):
        read(str(tmp_path / "t"))


@pytest.mark.parametrize(
    ("name", "unit"),
    [("time [µs]", "us"), ("time [μs]", "us"), ("t [milliseconds]", "ms"), ("t [UTC] [ns]", "ns")],
)
def test_a_stamps_unit_has_several_spellings(name: str, unit: str) -> None:
    assert column_of(name)[:2] == ("stamp", unit)


@pytest.mark.parametrize(
    ("header", "kinds"),
    [
        ("t,x,y,z,track_sec,cost_ms", "stamp x y z - -"),
        ("exposure_time,stamp,x,y,z,proc_time", "- stamp x y z -"),
        ("header.stamp.sec,header.stamp.nanosec,x,y,z", "stamp rest x y z"),
        ("secs,nsecs,x,y,z", "stamp rest x y z"),
        ("time,timestamp_ns,x,y,z,dt", "- stamp x y z -"),
    ],
)
def test_one_of_several_times_is_the_stamp(header: str, kinds: str) -> None:
    columns = columns_of(header.split(","))
    assert columns is not None
    assert " ".join(column.kind or "-" for column in columns) == kinds


@pytest.mark.parametrize(
    ("text", "stamps"),
    [
        (["0", "50000000", "100000000"], [0, 50_000_000, 100_000_000]),
        (["1200000000000", "1200050000000"], [1_200_000_000_000, 1_200_050_000_000]),  # 20 minutes
        (["1700000000.05", "1700000000.1"], [START + 50_000_000, START + 100_000_000]),
        (["1700000000050", "1700000000100"], [START + 50_000_000, START + 100_000_000]),
        (["1700000000", "1700000001"], [START, START + 10**9]),  # whole seconds
    ],
)
def test_the_unit_of_a_stamp_is_seen_by_its_size(
    text: Sequence[str], stamps: Sequence[int], tmp_path: Path
) -> None:
    """In a table with commas, whose habit are nanoseconds."""
    (tmp_path / "t").write_text("timestamp,x,y,z\n" + "".join(f"{stamp},0,0,0\n" for stamp in text))
    source = read(str(tmp_path / "t"))
    assert source.poses.stamps.tolist() == list(stamps)


def test_positions_alone_are_read_and_judged(tmp_path: Path) -> None:
    for text in (
        rows(seconds, "x y z", " "),
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n" + rows(str, "x y z", ","),
        rows(seconds, "x y z 0.0 0.0 0.0 0.0", " "),
    ):
        (tmp_path / "t").write_text(text)
        source = read(str(tmp_path / "t"))
        assert source.positions_only
        write_tum(tmp_path / "truth", POSE)
        alone = judged(str(tmp_path / "truth"), str(tmp_path / "t"))
        assert alone.figures["ate_rmse_m"] == pytest.approx(0, abs=1e-9)
        assert alone.figures["why_no_rotations"].startswith("it has no orientations")
        assert "rot_rmse_deg" not in alone.figures
        assert source.poses.positions == pytest.approx(POSE.positions)
        assert (source.poses.orientations == [1.0, 0.0, 0.0, 0.0]).all()


def test_what_is_left_out_is_counted_in_files_as_in_topics(tmp_path: Path) -> None:
    lines = rows(seconds, XYZW, " ").splitlines(keepends=True)
    lines[5] = lines[4]
    lines[9] = lines[7]
    lines[20] = f"{seconds(int(POSE.stamps[20]))} nan nan nan nan nan nan nan\n"
    (tmp_path / "t").write_text("".join(lines))

    def change(number: int, message: Any) -> Any:
        if number in {6, 10}:
            other = {6: 4, 10: 7}[number]
            message.header.stamp = bags.header(int(POSE.stamps[other]), "").stamp
        if number == 21:
            message.pose.position.x = np.nan
        return message

    bag = bags.bag(tmp_path / "bag", bags.POSE, POSE, change=change)
    for place in (str(tmp_path / "t"), f"{bag}:/slam/poses"):
        source = read(place)
        assert source.counts["repeated_stamps"] == 2
        assert source.notes == (
            "left out: 1 pose with NaN, 1 repeated stamp, 1 stamp that goes back",
        )
        assert len(source.poses) == 57


def judged(truth: str, estimate: str, **config: Any) -> Judgement:
    given = judgement.JudgeConfig(**config)
    true = read_truth(truth, axes=given.truth_axes)
    source = read(f"one={estimate}", given.axes)
    return judgement.judge_all(true, [source], None, given)[1]["one"]


@pytest.fixture(scope="module")
def containers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Write one trajectory, with numbers as they are, into containers that declare axes or not."""
    folder = tmp_path_factory.mktemp("containers")
    write_tum(folder / "t.tum", POSE)
    write_euroc(folder / "e.csv", POSE)
    write_kitti(folder / "k.txt", POSE)
    (folder / "times").write_text("".join(f"{seconds(t)}\n" for t in POSE.stamps.tolist()))
    numbers = POSE.matrices()
    world, body = np.linalg.inv(bags.FLIP), np.linalg.inv(bags.FLIP)
    turned = Trajectory.from_matrices(POSE.stamps, world @ numbers @ body)
    bags.bag(folder / "bag", bags.POSE, turned, frame_id="odom")
    return {
        "TUM": f"{folder}/t.tum",
        "EuRoC": f"{folder}/e.csv",
        "bag": f"{folder}/bag:/slam/poses",
    }


@pytest.mark.parametrize("truth", ["TUM", "EuRoC", "bag"])
@pytest.mark.parametrize("estimate", ["TUM", "EuRoC", "bag"])
def test_a_container_is_no_error(truth: str, estimate: str, containers: dict[str, str]) -> None:
    """Equal numbers are equal poses: a source without axes has those of the other one."""
    for alignment in ("se3", "none"):
        given = judged(containers[truth], containers[estimate], alignment=alignment)
        figures = given.figures
        assert figures["ate_max_m"] == pytest.approx(0, abs=1e-8)
        assert figures["rot_rmse_deg"] == pytest.approx(0, abs=1e-6)
        assert figures["rpe_1m_trans_percent"] == pytest.approx(0, abs=1e-5)


def test_kittis_truth_against_a_tum_file(containers: dict[str, str]) -> None:
    folder = Path(containers["TUM"]).parent
    true = read_truth(str(folder / "k.txt"), str(folder / "times"))
    source = read(containers["TUM"])
    _, judgements, _, _ = judgement.judge_all(true, [source], None, judgement.JudgeConfig())
    assert judgements["t"].figures["rot_rmse_deg"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("container", ["TUM", "EuRoC", "bag"])
@pytest.mark.parametrize("side", ["axes", "truth_axes"])
def test_axes_that_are_given_hold_for_every_container(
    container: str, side: str, containers: dict[str, str]
) -> None:
    """An estimate in ENU and FLU of a truth in NED and FRD, and the other way round."""
    enu = Trajectory.from_matrices(POSE.stamps, bags.ENU @ POSE.matrices() @ bags.FLIP)
    folder = Path(containers["TUM"]).parent
    write_tum(folder / "enu.tum", enu)
    places = [containers[container], str(folder / "enu.tum")]
    axes = {"truth_axes": "ned", "axes": "enu"}
    if side == "truth_axes":
        places, axes = places[::-1], {"truth_axes": "enu", "axes": "ned"}
    figures = judged(*places, alignment="none", **axes).figures
    assert figures["ate_max_m"] == pytest.approx(0, abs=1e-8)
    assert figures["rot_rmse_deg"] == pytest.approx(0, abs=1e-6)


def test_estimates_that_declare_different_bodies_need_the_truths(
    containers: dict[str, str], tmp_path: Path
) -> None:
    write_tum(tmp_path / "own.tum", POSE, "base_link (FRD) in odom, as it was sent")
    true = read_truth(containers["TUM"])
    sources = [read(containers["bag"]), read(str(tmp_path / "own.tum"))]
    message = r"expected the axes of the truth's body .*slam/poses: flu, own: frd\), found none"
    with pytest.raises(ValueError, match=message):
        judgement.judge_all(true, sources, None, judgement.JudgeConfig())
    true = read_truth(containers["TUM"], axes="enu")
    judgement.judge_all(true, sources, None, judgement.JudgeConfig())


@pytest.mark.parametrize(
    ("truth", "estimate", "usual"),
    [
        ("map (NED)", "map, as it was sent", "none"),
        ("map (NED)", "odom, as it was sent", "origin"),
        ("map (NED)", "", "se3"),
        ("", "map, as it was sent", "se3"),
        ("", "", "se3"),
    ],
)
def test_an_alignment_is_left_out_only_if_both_are_in_map(
    truth: str, estimate: str, usual: str, tmp_path: Path
) -> None:
    for name, frame in (("truth", truth), ("vo", estimate)):
        comment = f"base_link (FRD) in {frame}" if frame else ""
        write_tum(tmp_path / f"{name}.tum", POSE, comment)
    figures = judged(str(tmp_path / "truth.tum"), str(tmp_path / "vo.tum")).figures
    assert figures["alignment"] == usual


@pytest.mark.slow
def test_covariances_of_openvins_are_of_the_body_and_judged(tmp_path: Path) -> None:
    """The rotation's are about the body's axes: a long axis of the body turns with it."""
    truth = walk(400, start=START)
    rng = np.random.default_rng(4)
    deviations = np.array([0.03, 0.002, 0.002])
    turns = Rotation.from_rotvec(rng.normal(0.0, deviations, (400, 3)))
    places = truth.positions + rng.normal(0.0, 0.05, (400, 3))
    turned = (truth.rotations() * turns).as_quat(scalar_first=True)
    triangle = "9e-4 0 0 4e-6 0 4e-6 25e-4 0 0 25e-4 0 25e-4"
    text = "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 "
    text += "Pt23 Pt33\n"
    for stamp, (x, y, z), (qw, qx, qy, qz) in Trajectory(truth.stamps, places, turned).poses():
        text += f"{seconds(stamp)} {x} {y} {z} {qx} {qy} {qz} {qw} {triangle}\n"
    (tmp_path / "o.txt").write_text(text)
    write_tum(tmp_path / "truth.tum", truth)
    for axes in ("ned", "enu"):
        given = {"alignment": "none", "axes": axes, "truth_axes": axes}
        figures = judged(str(tmp_path / "truth.tum"), str(tmp_path / "o.txt"), **given).figures
        assert figures["covariances_percent"] == 100.0
        assert figures["nees_position"] == pytest.approx(3.0, rel=0.15)
        assert figures["nees_pose"] == pytest.approx(6.0, rel=0.15)


def test_velocities_of_a_file_are_judged(tmp_path: Path) -> None:
    write_euroc(tmp_path / "vo.csv", POSE)
    write_tum(tmp_path / "truth.tum", POSE)
    figures = judged(str(tmp_path / "truth.tum"), str(tmp_path / "vo.csv")).figures
    assert figures["velocities_percent"] == 100.0
    assert figures["velocity_rmse_m_per_s"] == pytest.approx(0, abs=1e-6)


def test_a_vehicle_of_several_is_named(tmp_path: Path) -> None:
    body = rows(lambda t: f"DRONE\t{t // 10**6}", WXYZ + " a.png", "\t")
    text = AIRSIM + body.replace("DRONE", "Drone1") + body.replace("DRONE", "Drone2")
    (tmp_path / "airsim_rec.txt").write_text(text)
    with pytest.raises(
        ValueError, match=r"expected one of Drone1, Drone2, as airsim_rec.txt:Drone1"
    ):
        read(str(tmp_path / "airsim_rec.txt"))
    source = read(f"{tmp_path / 'airsim_rec.txt'}:Drone2")
    assert len(source.poses) == len(POSE)


def test_the_page_has_the_table() -> None:
    page = (Path(__file__).parents[4] / "docs/how-to/judge-trajectories.md").read_text("utf-8")
    for reader in readers():
        cells = (reader.name, reader.recognized, reader.columns, reader.stamps, reader.axes)
        assert f"| {' | '.join(cells)} |\n" in page
