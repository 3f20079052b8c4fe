"""A program for tests, which knows nothing of ours but the client: ``stub.py MODE…``.

It says that the camera moves a millimetre along its axis for each grey level of the first pixel, so
that an answer depends on what was sent, and on nothing else.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from nodes.outside.native.client import Frame, Link
else:
    from client import Frame, Link  # $PYTHONPATH is the folder of that one file

modes = {word.partition("=")[0]: word.partition("=")[2] for word in sys.argv[1:]}


def pose_of(frame: Frame) -> npt.NDArray[np.float64]:
    """Return what is answered to a frame."""
    pose = np.eye(4)
    pose[2, 3] = frame.sequence + frame.images[0].data.flat[0] / 1000
    return pose


def main() -> None:
    """Answer as the modes say."""
    print("began", *modes, flush=True)
    if "deaf" in modes:  # to SIGTERM, and to the end of the run
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if "daemon" in modes and os.fork() == 0:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        Path(modes["daemon"]).write_text(str(os.getpid()))
        time.sleep(600)
    if "early" in modes:
        sys.exit("no vocabulary")
    held: list[Frame] = []
    stamps: list[int] = []
    with Link("stub") as link:
        link.ready("body" if "sure" in modes else "camera", "corrects" in modes)
        for frame in link:
            number = frame.sequence
            stamps.append(frame.stamp)
            if "log" in modes:
                imu = frame.rows("imu")
                link.log(f"imu {len(imu)} {imu['stamp'].tolist()}")
            if "flood" in modes:
                print("x" * 200 + "\n" * 500, flush=True)
            if "spies" in modes:  # wherever it was told of, and in the run's folder
                told = [Path(value) for name, value in os.environ.items() if "VISNAV" in name]
                places = {*told, Path(os.environ["VISNAV_FOLDER"]).parents[1]}
                files = [str(file) for place in places for file in place.rglob("*.tum")]
                link.log(f"spied: {files or 'nothing'}")
            if "logs" in modes and number == 5:
                for n in range(int(modes["logs"])):
                    link.log(f"\x1b[31m{n}\nmore")
            if "burns" in modes:
                until = time.process_time() + float(modes["burns"])
                while time.process_time() < until:
                    pass
            if "slow" in modes:
                time.sleep(float(modes["slow"]))
            if "dies" in modes and number == int(modes["dies"]) and first_time():
                print("out of features", flush=True)
                os._exit(7)
            if "killed" in modes and number == 5 and first_time():
                (Path(os.environ["VISNAV_FOLDER"]) / "when").write_text(repr(time.time()))
                os.kill(os.getpid(), signal.SIGKILL)
            if "hangs" in modes and number == int(modes["hangs"]):
                time.sleep(600)
            if "reversed" in modes:  # of two
                held.append(frame)
                if len(held) == 2:
                    for stamp in reversed(held):
                        link.pose(stamp, pose_of(stamp))
                    held.clear()
            elif "unsteady" in modes and number == 5:  # as threads make a system
                pose = pose_of(frame)
                pose[0, 3] = 1e-12 * os.getpid()
                link.pose(frame, pose)
            elif "sure" in modes:  # in a world of its own: a quarter of a turn about z
                pose = np.eye(4)[[1, 0, 2, 3]] * [[-1.0], [1.0], [1.0], [1.0]]
                pose[:3, 3] = (5.0, 6.0, 7.0 + number)
                spread = np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-4
                link.pose(frame, pose, covariance=spread, velocity=[0.1, 0.2, 0.3])
            elif "skips" in modes and number % 3:
                if modes["skips"] == "done":
                    link.done(frame)
            elif "starts" in modes and number < int(modes["starts"]):
                link.initialising(frame)
            elif "loses" in modes and number % 4 == 3:
                link.lost(frame)
            elif "nan" in modes and number == 5:
                link.pose(frame, pose_of(frame) * np.nan)
            elif "future" in modes and number == 5:
                link.pose(frame._replace(stamp=frame.stamp + 10**9), pose_of(frame))
            else:
                link.pose(frame, pose_of(frame))
                if "twice" in modes:
                    link.pose(frame, pose_of(frame) * 2 - np.eye(4))
        if (
            modes.get("corrects") == "well"
        ):  # the first at (0, 0, 1), then one step each to the right
            poses = np.tile(np.eye(4), (len(stamps), 1, 1))
            poses[:, 0, 3], poses[:, 2, 3] = np.arange(len(stamps)), 1.0
            link.trajectory(stamps, poses)
        elif modes.get("corrects") == "elsewhere":
            link.trajectory([stamps[0], stamps[1] + 5], np.tile(np.eye(4), (2, 1, 1)))
        elif modes.get("corrects") == "empty":
            link.trajectory([], np.empty((0, 4, 4)))
    if "deaf" in modes:
        time.sleep(600)
    if "fails" in modes:
        print("no disk", flush=True)
        sys.exit(3)


def first_time() -> bool:
    """Tell whether this is the program's first life in a run."""
    mark = Path(os.environ["VISNAV_FOLDER"]) / "lived"
    before = mark.exists()
    mark.touch()
    return not before


main()
