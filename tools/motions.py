"""Make the motions of the suite's long flights: examples/motions/walk.tum and drive.tum.

Both are a path at the height of a hand or a roof, to which the sway of a walk or of a car is added.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from events.frames import from_rpy
from nodes.pilots.waypoint_path import WaypointPath, plan
from sims.worlds import TOURS

Floats = npt.NDArray[np.float64]

FOLDER = Path("examples/motions")
HEAD = "# base_link (FRD) in map (NED): timestamp[s] tx ty tz[m] qx qy qz qw\n"
STRIDES = 0.9  # of a walk, two steps each, per second
BUMPS = (0.7, 1.3, 1.9)  # of a car on its springs, per second
ROUND = [  # a drive round the middle of the field, metres north and east, 11 m from all things
    [32.0, 20.0], [88.0, 20.0], [88.0, 104.0], [4.0, 104.0], [-80.0, 104.0],
    [-80.0, 20.0], [-80.0, -64.0], [4.0, -64.0], [32.0, -64.0], [32.0, 20.0],
]  # fmt: skip


def walk(rate: float = 25.0) -> str:
    """Return a walk of two rounds through the yard, a camera in the hand, 1.3 m/s.

    Two steps a stride lift the body by 4 cm and turn it a degree or two; it sways once a stride.
    """
    tour = [[x, y, -1.4] for x, y, _ in TOURS["yard"]]
    path = plan(
        np.array([*tour, *tour, tour[0]]), speed=1.3, acceleration=0.8, radius=1.0, yaw=0.0,
        turn_time=1.0, step=1 / rate,
    )  # fmt: skip
    speed = np.linalg.norm(path.velocity, axis=1)
    share = np.clip(speed / 1.3, 0.0, 1.0)
    stride = 2.0 * np.pi * STRIDES * np.arange(len(speed)) / rate
    rise = 0.02 * share * np.cos(2.0 * stride)
    sway = 0.02 * share * np.sin(stride)
    degrees = [1.5 * np.sin(stride), 1.0 * np.sin(2.0 * stride + 0.7), 2.0 * np.sin(stride + 0.4)]
    return _rows(path, rate, sway, rise, [np.radians(share * angle) for angle in degrees])


def drive(rate: float = 10.0) -> str:
    """Return a drive round the middle of the field, a camera on the roof, 8 m/s.

    The car sways by centimetres and tenths of a degree as the ground does.
    """
    corners = np.array([[x, y, -1.8] for x, y in ROUND])
    path = plan(
        corners, speed=8.0, acceleration=1.5, radius=12.0, yaw=0.0, turn_time=1.0, step=1 / rate
    )
    speed = np.linalg.norm(path.velocity, axis=1)
    share = np.clip(speed / 8.0, 0.0, 1.0)
    time = 2.0 * np.pi * np.arange(len(speed)) / rate
    first, second, third = (np.sin(bump * time + phase) for phase, bump in enumerate(BUMPS))
    rise = 0.02 * share * (first + 0.6 * second + 0.3 * third)
    degrees = [0.4 * first + 0.3 * third, 0.4 * second + 0.2 * first, 0.0 * first]
    return _rows(path, rate, 0.0 * rise, rise, [np.radians(share * angle) for angle in degrees])


def _rows(path: WaypointPath, rate: float, sway: Floats, rise: Floats, rpy: list[Floats]) -> str:
    """Return the rows of TUM; `sway` is to the right, `rise` up, metres; `rpy` radians."""
    roll, pitch, yaw = rpy[0], rpy[1], path.yaw + rpy[2]
    right = np.stack([-np.sin(path.yaw), np.cos(path.yaw), 0.0 * path.yaw], axis=1)
    places = path.position + sway[:, None] * right - rise[:, None] * [0.0, 0.0, 1.0]
    lines = []
    for index, place in enumerate(places):
        w, x, y, z = from_rpy(float(roll[index]), float(pitch[index]), float(yaw[index]))
        numbers = " ".join(f"{number:.4f}" for number in place)
        turn = " ".join(f"{number:.6f}" for number in (x, y, z, w))
        lines.append(f"{index / rate:.2f} {numbers} {turn}\n")
    return HEAD + "".join(lines)


if __name__ == "__main__":
    for name, text in (("walk", walk()), ("drive", drive())):
        (FOLDER / f"{name}.tum").write_text(text, encoding="utf-8")
        print(FOLDER / f"{name}.tum", len(text.splitlines()) - 1, "rows")
