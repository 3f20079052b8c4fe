"""Check of whether an estimate's orientations are those of the truth's body.

Positions alone fix the transform between the frames. What then remains between true and estimated
orientations, ``D_i = R_i⁻¹ · (R · R̂_i)``, shows what the orientations are:

- the identity, but for errors: those of the truth's body;
- another constant: those of a body that is turned against the truth's, as FLU against FRD, or a
  camera against its vehicle;
- no constant: those of nothing that moves with the body, as of a quaternion read in another order,
  of its inverse, or of rows that all have the same.
"""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import Quaternion
from nodes.judging.evaluation.alignment import umeyama
from nodes.judging.evaluation.metrics import rms, same_stamps
from nodes.trajectory import Trajectory

Floats = npt.NDArray[np.float64]
Kind = Literal["same", "turned", "truth without", "estimate without", "inverse", "order", "other"]

_EXTENT = (
    0.1  # positions fit if they are off by less than this share of their least relevant extent
)
_TURNED = 5.0  # degrees from which a constant turn is reported
_STILL = 2.0  # degrees: smaller rotations are ignored
_ROTATES = 10.0  # degrees that an estimate rotates by, beside a truth that never does
_LOOSE = 30.0  # degrees of spread from which orientations are none of this body
_BETTER = 0.25  # share of the spread that a guess has to leave to be right


WRONG: frozenset[Kind] = frozenset({"inverse", "order", "other"})
"""Findings for which the estimate is to blame; in a run, that it has none, too."""


class Orientations(msgspec.Struct, frozen=True, kw_only=True):
    """Finding about an estimate's orientations."""

    kind: Kind
    turn: Quaternion = (1.0, 0.0, 0.0, 0.0)  # mean D, estimate's body to the truth's, w x y z
    degrees: float = 0.0  # angle of the turn
    spread: float = 0.0  # root mean square of the angles from the turn, degrees

    @property
    def missing(self) -> bool:
        """Whether the truth or the estimate has positions only."""
        return self.kind in {"truth without", "estimate without"}

    @property
    def usable(self) -> bool:
        """Whether errors of orientations and of motions seen from the body mean anything."""
        return self.kind in {"same", "turned"}

    def text(self) -> str:
        """Return the finding as a sentence; empty if nothing is wrong."""
        if self.kind == "same":
            return ""
        if self.kind == "turned":
            return (
                f"its body is turned by {self.degrees:.1f}° about {self.axis()} against the "
                f"truth's, within {self.spread:.2g}°: rotations and relative errors are those of "
                "another body"
            )
        reason = {
            "truth without": "the truth has no orientations, the same stands in all of its rows",
            "estimate without": "it has no orientations, the same stands in all of its rows",
            "inverse": "its orientations are inverted, from the world to the body",
            "order": "its quaternions were read in the wrong order",
            "other": f"its orientations are none of this body's: {self.spread:.0f}° beside it",
        }[self.kind]
        return f"{reason}; figures of rotations and relative errors are left out"

    def axis(self) -> str:
        """Return the axis of the turn, in the truth's body: its name, or three numbers."""
        vector = np.array(self.turn[1:])
        vector = vector / np.linalg.norm(vector)
        largest = int(np.argmax(abs(vector)))
        if abs(vector[largest]) > 0.9998:  # a degree
            return f"{'-' if vector[largest] < 0 and self.degrees < 179.0 else ''}{'xyz'[largest]}"
        return f"({', '.join(f'{v:.2f}' for v in vector)})"


def examine(truth: Trajectory, estimate: Trajectory) -> Orientations | None:
    """Hold an estimate's orientations against those of the truth's body.

    Args:
        truth: True poses at the estimate's stamps.
        estimate: In a frame and a unit of its own.

    Returns:
        `None` if undecidable: positions on a line, or positions that do not fit. Of two
        without orientations the truth is named.

    Raises:
        ValueError: The stamps of the two differ.
    """
    same_stamps(truth, estimate)
    true, estimated = truth.rotations(), estimate.rotations()
    constant = [float(np.ptp(t.orientations, axis=0).max()) < 1e-9 for t in (truth, estimate)]
    rotates = [_mean_and_spread(rotations)[1] for rotations in (true, estimated)]
    if constant[0] and (constant[1] or rotates[1] > _ROTATES):
        return Orientations(kind="truth without")
    if constant[1]:
        return Orientations(kind="estimate without")
    try:
        matrix, translation, scale = umeyama(estimate.positions, truth.positions, with_scale=True)
    except ValueError:
        return None
    fitted = scale * estimate.positions @ matrix.T + translation
    residual = rms(np.linalg.norm(fitted - truth.positions, axis=1))
    centred = truth.positions - truth.positions.mean(axis=0)
    extents = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred))
    if residual > _EXTENT * extents[1]:
        return None
    frame = Rotation.from_matrix(matrix)
    mean, spread = _mean_and_spread(true.inv() * frame * estimated)
    degrees = float(np.degrees(mean.magnitude()))
    kind: Kind = "same"
    if spread > _STILL:
        guesses: dict[Kind, list[Rotation]] = {
            "inverse": [estimated.inv()],
            "order": [
                Rotation.from_quat(np.roll(estimated.as_quat(), by, axis=1)) for by in (1, -1)
            ],
        }
        for name, rotations in guesses.items():
            left = min(_mean_and_spread(true.inv() * frame * guess)[1] for guess in rotations)
            if left < max(_BETTER * spread, _STILL) and left < 0.5 * spread:
                kind = name
        if kind == "same" and spread > max(_LOOSE, 0.5 * rotates[0]):
            kind = "other"
    if kind == "same" and degrees > max(_TURNED, 3.0 * spread):
        kind = "turned"
    # The mean's quaternion has either sign; with a scalar above 0 its vector is the turn's axis.
    w, x, y, z = mean.as_quat(canonical=True, scalar_first=True).tolist()
    return Orientations(kind=kind, turn=(w, x, y, z), degrees=degrees, spread=spread)


def _mean_and_spread(rotations: Rotation) -> tuple[Rotation, float]:
    """Return the mean of rotations, and the root mean square of the angles from it, degrees."""
    mean = rotations.mean()
    return mean, float(np.degrees(rms((mean.inv() * rotations).magnitude())))
