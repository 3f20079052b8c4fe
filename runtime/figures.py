"""Figures of a verdict in a single table: meaning, place in reports, and thresholds.

Verdict, thresholds, report, sweep, the schema of the file and the documentation read this table. A
figure that is not in it is shown all the same, by its name, among all others.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import msgspec


class Figure(msgspec.Struct, frozen=True):
    """A figure of an estimator.

    Attributes:
        name: In files; its end is the unit.
        limit: Whether a threshold is the least value allowed, or the most; "" if there is none.
        default: The threshold where the file gives none.
        optional: Whether a threshold is not missed where there is no figure: not everybody sends
            velocities, and nobody who never restarts counts how often.
        if_known: Whether the same holds as long as the threshold is the default: a flight of less
            than a metre has no error over one.
        all_or_none: Percentage required as soon as there is any: of values sent with some of the
            poses only, somebody may have chosen with which.
        report: ``head`` and ``main`` stand at the top of a report, in this order.
        sweep: Column among the main figures of a sweep; 0 if it is none of them.
        plot: Title of its panel in the plots of a sweep; "" if there is none.
        of_flight: Whether it says how the vehicle flew; a missed threshold fails the flight, and
            not the estimators.
        heading: Head of its column in a table, without the unit; "" for the name in words.
    """

    name: str
    meaning: str
    limit: Literal["", "least", "most"] = ""
    default: float | None = None
    counts: bool = False
    optional: bool = False
    if_known: bool = False
    all_or_none: float | None = None
    report: Literal["head", "main", ""] = "main"
    sweep: int = 0
    plot: str = ""
    of_flight: bool = False
    heading: str = ""

    @property
    def of_orientation(self) -> bool:
        """Whether it means nothing unless orientations are those of the truth's body."""
        return self.name.startswith(_OF_ORIENTATION)

    @property
    def unit(self) -> str:
        """Of its values; "" if they have none."""
        return next((unit for end, unit in _UNITS.items() if self.name.endswith(end)), "")

    @property
    def column(self) -> str:
        """Head of its column, without the unit: ``ATE``."""
        end = next((end for end in _UNITS if self.name.endswith(end)), "")
        return self.heading or self.name.removesuffix(end).replace("_", " ")

    @property
    def better(self) -> Literal["", "less", "more"]:
        """Which of two values is better; "" if that is not known, as of NEES, where 3 is right."""
        if self.name.startswith("nees_"):
            return ""
        if self.limit:
            return "more" if self.limit == "least" else "less"
        return "less" if self.name.startswith(_LESS_IS_BETTER) else ""

    @property
    def after_alignment(self) -> bool:
        """Whether it is an error after the alignment that the verdict names.

        Shares, times, the flight's own figures, and those whose name has an alignment are not.
        """
        if self.of_flight or {"se3", "sim3"} & {*self.name.split("_")}:
            return False
        if self.unit == "%":
            return self.limit != "least"
        return self.unit in {"m", "m²", "°", "°/m", "m/s"}

    @property
    def side(self) -> str:
        """Comparison sign before the threshold in a table."""
        return "≥" if self.limit == "least" else "≤"

    @property
    def setting(self) -> str:
        """Description of the threshold, for the reference of settings."""
        unit = f" ({self.unit})" if self.unit else ""
        if self.all_or_none is not None:
            unit += f"; if it is not given, {self.all_or_none:g} where there is any"
        return f"{self.meaning[0].upper()}{self.meaning[1:]}{unit}, at {self.limit}."

    def missed(self, limit: float | None, value: Any) -> str:
        """Return a sentence if a value does not meet a threshold, or else nothing.

        Args:
            limit: `None` or an infinite one for none.
        """
        if limit is None and value is not None:
            limit = self.all_or_none
        if limit is None or is_off(limit):
            return ""
        if value is None and (self.optional or (self.if_known and limit == self.default)):
            return ""
        shown = "none" if value is None else f"{value:.4g}"
        if value is not None and (value >= limit if self.limit == "least" else value <= limit):
            return ""
        return f"{self.name}: expected at {self.limit} {limit:g}, found {shown}"


def is_off(limit: float | None) -> bool:
    """Return whether a threshold is infinite, which switches a default off."""
    return limit is not None and math.isinf(limit)


_OF_ORIENTATION = (
    "rpe_", "rot_", "heading_", "final_rot_", "newest_pose_rot_", "end_error_", "nees_pose",
)  # fmt: skip
_LESS_IS_BETTER = (
    "ate_", "flight_ate_", "final_ate_", "final_flight_ate_", "final_rot_", "rpe_", "heading_",
    "newest_pose_", "latency_p", "lost_", "relocalization_", "plan_", "cpu_", "peak_rss_",
)  # fmt: skip
"""Begin names of figures without a threshold of which less is better."""
_UNITS = {
    "_percent": "%", "_deg_per_m": "°/m", "_m_per_s": "m/s", "_deg": "°", "_ms": "ms", "_hz": "Hz",
    "_m": "m", "_seconds": "s", "_mb": "MB",
}  # fmt: skip


def _error(name: str, meaning: str, **more: Any) -> Figure:
    return Figure(name, meaning, "most", **more)


def _share(name: str, meaning: str, **more: Any) -> Figure:
    return Figure(name, meaning, "least", **more)


def _count(name: str, meaning: str, default: int | None = 0, **more: Any) -> Figure:
    return Figure(name, meaning, "most", default, True, True, **more)


def _detail(name: str, meaning: str) -> Figure:
    return Figure(name, meaning, report="")


SHARES, KITTI_LENGTHS = (1, 2, 5, 10, 20), range(100, 900, 100)
"""Lengths of stretches for relative errors: percent of the path; metres."""


def _segments() -> list[Figure]:
    """Return the relative errors over stretches, as the KITTI benchmark has them."""
    both = (("trans_percent", "position"), ("rot_deg_per_m", "rotation"))
    lengths = {f"{share}pct": f"{share} % of the path" for share in SHARES}
    lengths |= {f"{metres}m": f"{metres} m" for metres in KITTI_LENGTHS}
    means = {"mean": "1 to 20 % of the path", "kitti": "100 to 800 m"}
    details = [
        _detail(f"rpe_{k}_{end}", f"RPE over {text}, {what}, mean")
        for k, text in lengths.items()
        for end, what in both
    ]
    return details + [
        Figure(f"rpe_{k}_{end}", f"RPE, mean over stretches of {text}, {what}")
        for k, text in means.items()
        for end, what in both
    ]


_TABLE = (
    _detail("method", "what the estimator says that it is"),
    _detail("vehicle", "vehicle by which it was judged"),
    Figure("alignment", "how it was laid on the truth", report="head"),
    _detail("compared_at", "camera at which it is compared, instead of the body"),
    _detail("scale", "by what Sim(3) multiplies its lengths; 1 is right if they are in metres"),
    _detail("estimates", "poses that count"),
    _detail("compared", "poses for whose time a true pose is known"),
    _share("compared_percent", "share of the poses near a compared one", default=50.0, report=""),
    _detail("path_m", "length of the true path in the flight"),
    _error(
        "ate_rmse_m", "absolute trajectory error (ATE), RMS", report="head", sweep=1,
        heading="ATE",
    ),
    _error(
        "ate_percent", "ATE in percent of the path", report="head", sweep=2,
        plot="trajectory error (% of the path)", heading="ATE",
    ),
    _detail("ate_mean_m", "ATE, mean"),
    _detail("ate_median_m", "ATE, median"),
    _detail("ate_std_m", "ATE, standard deviation"),
    _detail("ate_north_rmse_m", "error along north, RMS"),
    _detail("ate_east_rmse_m", "error along east, RMS"),
    _detail("ate_down_rmse_m", "error along down, RMS"),
    _detail("ate_se3_rmse_m", "ATE if aligned as a whole (SE3), RMS"),
    _detail("ate_sim3_rmse_m", "ATE if aligned as a whole with scale (Sim3), RMS"),
    _detail("flight_ate_rmse_m", "ATE over the whole flight, lost time as 100 % drift, RMS"),
    _error(
        "flight_ate_percent", "ATE over the whole flight, lost time as 100 % drift", report="head",
        sweep=3, heading="ATE, whole flight",
    ),
    _detail("final_poses", "poses of the trajectory after loop closures"),
    Figure("final_ate_rmse_m", "ATE after loop closures", report="head", heading="ATE, final"),
    _error(
        "final_ate_percent", "ATE after loop closures, in percent of the path", report="head",
        heading="ATE, final",
    ),
    _detail("final_rot_rmse_deg", "rotation error after loop closures, RMS"),
    _detail("final_flight_ate_rmse_m", "ATE after loop closures over the whole flight, RMS"),
    Figure("final_flight_ate_percent", "the same over the whole flight", report="head"),
    _detail("why_not_final", "why the trajectory after loop closures was not judged"),
    _error("ate_max_m", "greatest position error"),
    _error("rot_rmse_deg", "rotation error, RMS", default=15.0, if_known=True, heading="rotation"),
    _error(
        "rpe_1m_trans_percent", "relative pose error (RPE) over 1 m, position, RMS", default=75.0,
        if_known=True, sweep=4, heading="RPE, 1 m",
    ),
    _error(
        "rpe_1m_rot_deg_per_m", "relative pose error (RPE) over 1 m, rotation, RMS", sweep=5,
        heading="RPE, 1 m",
    ),
    *_segments(),
    _detail("rpe_frame_trans_m", "RPE from each pose to the next, position, RMS"),
    _detail("rpe_frame_rot_deg", "RPE from each pose to the next, rotation, RMS"),
    _error("end_error_percent", "error of the last pose seen from the first, % of the path"),
    _error("lost_seconds", "time without a pose", sweep=7, plot="lost (s)", heading="lost"),
    Figure("lost_count", "times lost"),
    _error("initialization_seconds", "time before the first pose", heading="first pose"),
    _detail("relocalization_p50_seconds", "time to have a pose again, median"),
    Figure("relocalization_max_seconds", "longest time to have a pose again"),
    _detail("latency", "whether latencies are declared by the file, or measured"),
    Figure("latency_p50_ms", "latency, median", sweep=9, heading="latency"),
    _error("latency_p99_ms", "latency, 99th percentile"),
    _error(
        "newest_pose_rmse_m", "error of the newest pose at control ticks, RMS", sweep=10,
        plot="error of the newest pose (m)", heading="newest pose",
    ),
    Figure("newest_pose_rot_rmse_deg", "rotation error of the same, RMS"),
    _error("newest_pose_age_ms", "age of the newest pose at control ticks, mean", report=""),
    _error("velocity_rmse_m_per_s", "velocity error, RMS", optional=True),
    _error(
        "velocity_error_percent", "velocity error in percent of the true speed", default=75.0,
        optional=True,
    ),
    Figure("heading_rmse_deg", "heading error, RMS"),
    _error(
        "nees_position", "NEES of the position, 3 if consistent", default=1000.0, optional=True,
        heading="NEES (3 is right)",
    ),
    Figure("nees_pose", "NEES of the pose, 6 if consistent"),
    _detail("nees_position_inside_percent", "share of the positions within 95 % bounds of NEES"),
    _detail("nees_pose_inside_percent", "share of the poses within 95 % bounds of NEES"),
    _share(
        "within_3_sigma_percent", "share of the positions within 3 sigma of their covariance",
        optional=True,
    ),
    _error(
        "plan_rmse_m", "distance of the flight from its plan, RMS",
        plot="distance of the flight from its plan (m)", of_flight=True,
    ),
    Figure("plan_max_m", "greatest distance of the flight from its plan", of_flight=True),
    _share(
        "coverage_percent", "share of the flight with poses", default=90.0, report="head", sweep=6,
        heading="coverage",
    ),
    _share("frame_coverage_percent", "share of the images with a pose"),
    _share("velocities_percent", "share of the poses with a velocity", all_or_none=95.0),
    _share("covariances_percent", "share of the poses with a covariance", all_or_none=95.0),
    _count("covariance_invalid", "covariances that are not symmetric and positive definite"),
    _error(
        "covariance_too_large_percent", "share of the covariances too large to say anything",
        default=5.0, optional=True,
    ),
    _count("restarts", "times that it began anew, in a frame of its own or as a node", sweep=8),
    _count("repeated_stamps", "poses whose stamp was not later than the one before"),
    _count("future_stamps", "poses and losses of a time that had not come"),
    _count("not_causal", "poses so late that later images may be in them", None),
    _error("not_causal_percent", "share of such poses", default=5.0, optional=True),
    _detail("camera", "camera or lidar whose images or scans were to be answered"),
    _share(
        "stamped_at_images_percent", "share of the answered images with a pose at their stamp",
        default=90.0, optional=True,
    ),
    _count("other_bodies", "poses of another body than the truth's"),
    _error(
        "early_end_seconds", "time that the run ended before its plan", default=0.0, optional=True
    ),
    Figure("ended_by", "who ended the run"),
    Figure("commands", "what it has ordered a vehicle to do"),
    Figure("reads_truth", "whether it reads the truth"),
    _count("collisions", "collisions of the vehicle", of_flight=True),
    Figure("rate_hz", "estimates a second"),
    _detail("time_offset_ms", "what added to its stamps would make it fit best"),
    _detail("orientations", "whether they are the same body's, as far as positions tell"),
    _detail("body_rotation_deg", "constant turn of its body against the truth's"),
    _detail("body_rotation_spread_deg", "rotations beside that turn, RMS"),
    _detail("why_no_rotations", "why figures of rotations and relative errors are left out"),
    _detail("why", "why it, or a part of it, could not be judged"),
)  # fmt: skip

FIGURES = {figure.name: figure for figure in _TABLE}
"""All figures by name; those with thresholds in the order of ``verdict.json``."""

IN_SWEEPS = tuple(f.name for f in sorted(_TABLE, key=lambda f: f.sweep) if f.sweep)
"""Figures of an estimator summarised in a sweep's ``summary.csv``, if in the verdict."""


def figure(name: str) -> Figure:
    """Return the entry of a figure; for a name not in the table, the name in words."""
    return FIGURES.get(name) or Figure(name, name.replace("_", " "), report="")
