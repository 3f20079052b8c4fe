"""The six proofs: a rig's data from the calibration room, compared with its announcements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, Imu, ImuAnnouncement
from events.geometry import pose_matrix
from nodes.calibration.formats import FORMATS, GRAVITY, imu_axes, write_files
from nodes.calibration.room import NEAREST, Floats, Motion, _Collector, hits, read, spheres
from nodes.data.dataset.recording import Rig

INTEGRATED = 5.0  # seconds of IMU integration
_POSITION, _GLOBAL, _ROLLING, _DEPTH, _EXPORT = 0.005, 0.1, 0.3, 0.005, 1e-5
"""Metres; pixels, global and rolling shutter; metres; pixels."""
_MOST = 0.99  # least share of points, and of depths, within the limit; others: within 3 times
_LATE, _PLACE, _TURN = 2e-4, 5e-4, 5e-4  # largest errors of stamps and poses: s, m, rad


class Figure(msgspec.Struct, frozen=True):
    """Measured number of a proof, with its limit."""

    subject: str
    name: str
    value: float
    limit: float | None = None  # greatest allowed; None if nothing is
    unit: str = ""
    remark: str = ""  # fault, or why nothing can be shown, in a sentence

    @property
    def passed(self) -> bool:
        """Return whether the value is within its limit; false for NaN."""
        return self.limit is None or self.value <= self.limit


def judged(subject: str, name: str, value: float, limit: float, unit: str, wrong: str) -> Figure:
    """Return a figure, with `wrong` as its remark if the limit is exceeded."""
    return Figure(subject, name, value, limit, unit, "" if value <= limit else wrong)


class Points(msgspec.Struct, frozen=True, eq=False):
    """Discs of a camera's images: where they are, where they should be, and how they move."""

    pixels: Floats  # expected centroids, columns and rows, shape (n, 2)
    off: Floats  # measured less expected, shape (n, 2)
    flow: Floats  # pixels per second, shape (n, 2)


def integration(imu: ImuAnnouncement, samples: Sequence[Imu], motion: Motion, start: int) -> Figure:
    """Return how far the ideal IMU, integrated, gets from the truth: proof 1.

    Rotations are exponentials of the mean of two angular velocities; velocity and position follow
    by the trapezoidal rule on splines through the samples; of an IMU that averages, by its sample.
    """
    used = [s for s in samples if start <= s.stamp <= start + round(INTEGRATED * 1e9)]
    stamps = np.array([s.stamp for s in used], np.int64)
    rates = np.array([s.angular_velocity for s in used])
    forces = np.array([s.linear_acceleration for s in used])
    places, turns = motion.mounted(stamps, imu.position, imu.orientation)
    near = 1_000_000
    a, b = (motion.mounted(stamps[:1] + d, imu.position, imu.orientation)[0] for d in (-near, near))
    turn, place, velocity = turns[0], places[0].copy(), (b[0] - a[0]) / (2e-9 * near)
    gravity = np.array([0.0, 0.0, GRAVITY])
    seconds = (stamps - stamps[0]) / 1e9
    if not imu.averaged:
        refined = np.interp(np.arange(4 * len(stamps) - 3) / 4.0, np.arange(len(stamps)), seconds)
        rates, forces = (CubicSpline(seconds, values)(refined) for values in (rates, forces))
        seconds = refined
    for index, step in enumerate(np.diff(seconds), 1):
        rate = rates[index] if imu.averaged else (rates[index - 1] + rates[index]) / 2.0
        after = turn * Rotation.from_rotvec(rate * step)
        if imu.averaged:
            middle = turn * Rotation.from_rotvec(rate * step / 2.0)
            force = middle.apply(forces[index])
        else:
            force = (turn.apply(forces[index - 1]) + after.apply(forces[index])) / 2.0
        place += velocity * step + 0.5 * step**2 * (force + gravity)
        velocity = velocity + step * (force + gravity)
        turn = after
    off = float(np.linalg.norm(place - places[-1]))
    length = seconds[-1]
    wrong = (
        f"the ideal IMU, integrated over {length:.2f} s, ends {off:.3f} m from the truth: its "
        "samples, their stamps or its mounting are not what is announced"
    )
    return judged(imu.source, f"position after {length:.2f} s", off, _POSITION, "m", wrong)


def discs(
    camera: CameraAnnouncement, collected: _Collector, motion: Motion, angle: float
) -> Points:
    """Return measured and expected positions of all discs seen whole and separately."""
    info, points = camera.info, []
    grid = np.stack(np.meshgrid(np.arange(info.width), np.arange(info.height)), axis=-1)
    rays = info.unproject(grid.reshape(-1, 2)).reshape(*grid.shape[:2], 3)
    balls, radii = spheres(angle)
    for stamp, image in collected.images[camera.source].items():
        if stamp < collected.taken_off:
            continue
        places, turns = motion.rows_of(camera, stamp)
        later, turned = motion.rows_of(camera, stamp + 1_000_000)
        into, later_into = (
            rotations.as_matrix().transpose(0, 2, 1) for rotations in (turns, turned)
        )
        vehicle_pixels = collected.vehicle_pixels[camera.source].get(stamp)
        boxes = list(_boxes(camera, balls, radii, places, into))
        for ball, (left, top, right, bottom) in boxes:
            left, top, right, bottom = left - 4, top - 4, right + 4, bottom + 4
            separate = all(
                other == ball or x0 > right or x1 < left or y0 > bottom or y1 < top
                for other, (x0, y0, x1, y1) in boxes
            )
            inside = left >= 0 and top >= 0 and right < info.width and bottom < info.height
            window = np.s_[top : bottom + 1, left : right + 1]
            if not (separate and inside) or (
                vehicle_pixels is not None and vehicle_pixels[window].any()
            ):
                continue
            rows = np.arange(top, bottom + 1)
            towards = np.einsum("rij,rj->ri", into[rows], balls[ball] - places[rows])
            distance = np.linalg.norm(towards, axis=1)
            # Radians by which each pixel lies within the sphere's outline.
            cosine = np.einsum("rcj,rj->rc", rays[window], towards / distance[:, None])
            within = np.arcsin(radii[ball] / distance)[:, None] - np.arccos(np.clip(cosine, -1, 1))
            if not np.isfinite(within).all():
                continue
            pixels, measured = grid[window], image[window].astype(np.float64)
            half = ((measured > 20.0) & (measured < 235.0)).astype(np.uint8)
            if cv2.erode(half, np.ones((3, 3), np.uint8)).any():
                continue  # behind the vehicle's turning rotors, which depth images do not show
            if np.isin(measured, (0.0, 255.0)).all():  # a pixel shows what its centre's ray meets
                expected = (within > 0.0).astype(np.float64)
            else:
                slope = np.maximum(np.hypot(*np.gradient(within)), 1e-12)
                expected = np.clip(0.5 + within / slope, 0.0, 1.0)
            if measured.sum() < 0.3 * 255.0 * expected.sum():
                measured_centre = np.array([np.nan, np.nan])  # no disc in the image
            else:
                measured_centre = np.tensordot(measured, pixels, 2) / measured.sum()
            expected_centre = np.tensordot(expected, pixels, 2) / expected.sum()
            row = int(np.clip(np.rint(expected_centre[1]), 0, info.height - 1))
            ends = [
                info.project(to_camera[row] @ (balls[ball] - origins[row]))[0]
                for origins, to_camera in ((places, into), (later, later_into))
            ]
            points.append(
                (expected_centre, measured_centre - expected_centre, (ends[1] - ends[0]) / 1e-3)
            )
    columns: Floats = np.array(points, np.float64).reshape(-1, 3, 2)
    return Points(columns[:, 0], columns[:, 1], columns[:, 2])


def projection(camera: CameraAnnouncement, points: Points) -> Figure:
    """Return how far known points are beside their pixels: proof 3."""
    limit = _ROLLING if camera.readout else _GLOBAL
    distance = np.linalg.norm(points.off, axis=1)
    worst = float(np.quantile(distance, _MOST)) if len(distance) else float("nan")
    largest = float(np.nanmax(distance, initial=0.0))
    worst = largest if largest > 3.0 * limit else worst
    unseen = int(np.isnan(distance).sum())
    wrong = "no sphere of the room was seen whole, so nothing is proven"
    if len(distance):
        missing = f", and {unseen} are missing" if unseen else ""
        wrong = f"points fall up to {largest:.2f} px beside their pixels{missing}"
        wrong += _likely_cause(camera, points)
    name = f"{_MOST:.0%} of {len(distance)} points beside their pixels"
    return judged(camera.source, name, worst, limit, "px", f"{camera.source}: {wrong}")


def depth(
    camera: CameraAnnouncement, collected: _Collector, motion: Motion, angle: float
) -> Figure:
    """Return how far a camera's depth is from the true surfaces: proof 4."""
    off: list[Floats] = []
    ratio: list[Floats] = []
    for stamp, samples in collected.depths[camera.source].items():
        if stamp < collected.taken_off:
            continue
        places, turns = motion.rows_of(camera, stamp)
        rows = samples[:, 1].astype(int)
        surfaces = []
        for shift in ((0.0, 0.0), (4.0, 0.0), (-4.0, 0.0), (0.0, 4.0), (0.0, -4.0)):
            rays = camera.info.unproject(samples[:, :2] + shift)
            valid = np.asarray(np.isfinite(rays).all(axis=1))
            turned = turns[rows].apply(np.where(valid[:, None], rays, [0.0, 0.0, 1.0]))
            along, numbers = hits(angle, places[rows], turned)
            surfaces.append((rays[:, 2] * along, np.where(valid, numbers, -99)))
        # Not at edges, nor where the vehicle itself may be.
        same = np.array([numbers == surfaces[0][1] for _, numbers in surfaces])
        clear = same.all(axis=0) & (surfaces[0][1] > -99)
        clear &= np.isfinite(samples[:, 2]) & (samples[:, 2] > NEAREST)
        wrong = samples[:, 2] - surfaces[0][0]
        if camera.readout:  # rows may be as far off as proof 3 allows
            slope = sum(np.abs(surfaces[k][0] - surfaces[k + 1][0]) / 8.0 for k in (1, 3))
            wrong = np.sign(wrong) * np.maximum(np.abs(wrong) - _ROLLING * slope, 0.0)
        off.append(wrong[clear])
        ratio.append(samples[clear, 2] / surfaces[0][0][clear])
    errors = np.abs(np.concatenate(off)) if off else np.zeros(0)
    worst, remark = float("nan"), "no depth came, so nothing is proven"
    if len(errors):
        worst = float(np.quantile(errors, _MOST))
        remark = (
            f"depth is up to {1e3 * worst:.1f} mm beside the true surfaces: its median is "
            f"{float(np.median(np.concatenate(ratio))):.4f} times the truth"
        )
    name = f"{_MOST:.0%} of {len(errors)} depths beside the surfaces"
    return judged(camera.source, name, worst, _DEPTH, "m", f"{camera.source}: {remark}")


def exported(rig: Rig, folder: Path) -> Iterator[Figure]:
    """Yield by how much each format's files, read back, project differently: proof 5."""
    generator = np.random.default_rng(5)
    for name in FORMATS:
        try:
            files = write_files(rig, name)
        except ValueError as error:
            yield Figure(rig.body, name, 0.0, None, "px", f"not written: {error}")
            continue
        (folder / name).mkdir(parents=True, exist_ok=True)
        for file, text in files.items():
            (folder / name / file).write_text(text, encoding="utf-8")
        yield read_back(rig, name, folder / name, generator)


def read_back(rig: Rig, name: str, folder: Path, generator: np.random.Generator) -> Figure:
    """Return by how much a format's files in a folder project differently than announced."""
    worst = 0.0
    body = np.eye(4) if rig.imu is None else pose_matrix(rig.imu.position, rig.imu.orientation)
    axes = imu_axes(rig, ros=FORMATS[name].topics)
    for camera, read_camera in zip(rig.cameras, read(name, folder), strict=False):
        if rig.imu is None and name == "orbslam3":
            continue  # whose file has no transform without an IMU
        size = (camera.info.width - 1, camera.info.height - 1)
        rays = camera.info.unproject(generator.uniform((0, 0), size, (400, 2)))
        rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)]
        rays *= generator.uniform(1.0, 20.0, (len(rays), 1))
        pose = axes @ np.linalg.inv(body) @ pose_matrix(camera.position, camera.orientation)
        pixels = read_camera.project(rays @ pose[:3, :3].T + pose[:3, 3])
        off = float(np.abs(pixels - camera.info.project(rays)).max(initial=0.0))
        worst = max(worst, off if np.isfinite(off) else float("inf"))
    wrong = f"the files for {name} project up to {worst:.3g} px beside what is announced"
    return judged(rig.body, name, worst, _EXPORT, "px", wrong)


def stamps(
    camera: CameraAnnouncement, collected: _Collector, motion: Motion, points: Points | None
) -> Iterator[Figure]:
    """Yield the agreement of image, depth, pose and IMU at each exposure: proof 6."""
    source = camera.source
    exposures = set(collected.images[source]) | set(collected.depths[source])
    for name, by_source in (("images", collected.images), ("depth images", collected.depths)):
        if by_source[source]:
            unmatched = len(exposures - set(by_source[source]))
            wrong = f"{source}: {unmatched} exposures have no {name[:-1]} of their stamp"
            yield judged(source, f"exposures without {name}", unmatched, 0, "", wrong)
    half = round(camera.readout * 5e8)
    expected = {s + d for s in exposures for d in ({0, half, -half} if half else {0})}
    poses = collected.poses[source]
    missing = sum(not any(s + d in poses for d in (0, 1, -1)) for s in expected)
    wrong = f"{source}: {missing} poses of rows are missing, or bear other stamps"
    yield judged(source, "poses of rows missing", missing, 0, "", wrong)
    times = np.array(sorted(s for s in poses if s >= collected.taken_off), np.int64)
    true = times - round(camera.time_offset * 1e9)
    times, true = times[true <= motion.stamps[-1]], true[true <= motion.stamps[-1]]
    if len(times):
        places, turns = motion.mounted(true, camera.position, camera.orientation)
        off = np.array([poses[s].position for s in times.tolist()]) - places
        sent = [poses[s].orientation for s in times.tolist()]
        angle = (turns.inv() * Rotation.from_quat(sent, scalar_first=True)).magnitude()
        for name, value, limit, unit in (
            ("camera poses beside odometry and mounting", np.linalg.norm(off, axis=1), _PLACE, "m"),
            ("camera poses turned against them", angle, _TURN, "rad"),
        ):
            worst = float(value.max())
            wrong = f"{source}: {name} by {worst:.2g} {unit}: stamps or mounting are not true"
            yield judged(source, name, worst, limit, unit, wrong)
    if points is not None and len(points.off):
        yield _late(f"{source}", "images", points.flow, points.off)


def lateness(imu: ImuAnnouncement, collected: _Collector, motion: Motion) -> Figure:
    """Return by how much the IMU's samples are off their stamps, in proof 6 too."""
    at = np.array([sample.stamp for sample in collected.imu], np.int64)
    flying = (at > collected.taken_off) & (at < motion.stamps[-1] - 1_000_000)
    turn = Rotation.from_quat(imu.orientation, scalar_first=True)
    rates = turn.apply([sample.angular_velocity for sample in collected.imu])[flying]
    # A mean belongs to the middle of its period.
    then = at[flying] - (0.5e9 / imu.rate if imu.averaged else 0.0)
    true = np.column_stack([np.interp(then, motion.stamps, axis) for axis in motion.rates.T])
    return _late(imu.source, "IMU samples", np.gradient(true, then / 1e9, axis=0), rates - true)


def _late(source: str, signal: str, flow: Floats, off: Floats) -> Figure:
    """Return the delay of a signal, by its rate of change and its error."""
    finite = np.isfinite(off).all(axis=1)
    moved = float((flow[finite] ** 2).sum())
    late = -float((off[finite] * flow[finite]).sum()) / moved if moved else 0.0
    wrong = (
        f"{source}: {signal} show what was {abs(1e3 * late):.2f} ms "
        f"{'before' if late > 0 else 'after'} the time that their stamps say"
    )
    return judged(source, f"{signal} off their stamps", abs(late), _LATE, "s", wrong)


def _boxes(
    camera: CameraAnnouncement, balls: Floats, radii: Floats, places: Floats, into: Floats
) -> Iterator[tuple[int, tuple[int, int, int, int]]]:
    """Yield the possibly visible spheres, and the pixel box of each."""
    info = camera.info
    middle = info.height // 2
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rough = info.project((balls - places[middle]) @ into[middle].T)
    for number in np.flatnonzero(np.isfinite(rough).all(axis=1)):
        row = int(np.clip(rough[number, 1], 0, info.height - 1))
        centre = into[row] @ (balls[number] - places[row])
        direction = centre / np.linalg.norm(centre)
        side = np.cross(direction, [1.0, 0.0, 0.0] if abs(direction[0]) < 0.9 else [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        circle = np.outer(np.cos(turn), side) + np.outer(np.sin(turn), np.cross(direction, side))
        outline = info.project(centre + radii[number] * 1.02 * circle)
        if np.isfinite(outline).all():
            low, high = np.floor(outline.min(axis=0)), np.ceil(outline.max(axis=0))
            yield int(number), (int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def _likely_cause(camera: CameraAnnouncement, points: Points) -> str:
    """Return the announced number most likely wrong, as a remark; empty if none fits."""
    info = camera.info
    finite = np.isfinite(points.off).all(axis=1)
    off, pixels, flow = points.off[finite], points.pixels[finite], points.flow[finite]
    if len(off) < 10:
        return ""
    offset = pixels - (info.cx, info.cy)
    share = (pixels[:, 1] / max(info.height - 1, 1) - 0.5)[:, None]
    ones, zeros = np.ones(len(off)), np.zeros(len(off))
    causes: Mapping[str, tuple[npt.NDArray[np.float64], float, float, str]] = {
        "fx and fy": (offset, info.fx, info.fx, "px"),
        "fx": (np.column_stack([offset[:, 0], zeros]), info.fx, info.fx, "px"),
        "fy": (np.column_stack([zeros, offset[:, 1]]), info.fy, info.fy, "px"),
        "cx": (np.column_stack([ones, zeros]), info.cx, 1.0, "px"),
        "cy": (np.column_stack([zeros, ones]), info.cy, 1.0, "px"),
        "time_offset": (-flow, 1e3 * camera.time_offset, 1e3, "ms"),
        "readout": (flow * share, 1e3 * camera.readout, 1e3, "ms"),
    }
    residuals = {}
    for name, (change, _, _, _) in causes.items():
        scale = float((off * change).sum() / max((change**2).sum(), 1e-12))
        residuals[name] = (float(((off - scale * change) ** 2).sum()), scale)
    name = min(residuals, key=lambda key: residuals[key][0])
    residual, scale = residuals[name]
    if residual > 0.25 * float((off**2).sum()):
        return ""
    _, announced, factor, unit = causes[name]
    return (
        f": as if {name} were {announced + scale * factor:.4g} {unit}, not {announced:.4g} {unit}"
    )


# Proof 2: Allan deviation of a stationary IMU, compared with the announced noise.
#
# IEEE Std 952-1997, annex C: σ²(τ) = N²/τ of white noise with the density N, K²τ/3 of a random walk
# with the density K. Both are fitted at once, to the overlapping estimates of all axes; the fit's
# tolerance comes from as many samples made of the announced numbers.

ALLOWED = 0.10  # permitted relative difference between measured and announced density
_TRIALS = 24


class Curve(msgspec.Struct, frozen=True, eq=False):
    """Allan deviation of a sensor, measured and as announced; arrays have the shape (n,)."""

    name: str
    seconds: Floats
    measured: Floats
    announced: Floats


def variances(
    samples: Floats,  # at equal intervals, shape (n, axes)
    rate: float,  # hertz
) -> tuple[Floats, Floats]:
    """Return averaging times (s) and overlapping Allan variances, mean of all axes."""
    sums = np.vstack([np.zeros(samples.shape[1]), np.cumsum(samples - samples.mean(0), axis=0)])
    steps = np.unique(np.geomspace(1, len(samples) // 6, 22).astype(int))
    allan = [((sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]) / m).var() / 2.0 for m in steps]
    return steps / rate, np.array(allan)


def densities(seconds: Floats, allan: Floats, white: float, walk: float) -> tuple[float, float]:
    """Return N and K fitted to Allan variances, weighted by the announced densities."""
    terms = np.column_stack([1.0 / seconds, seconds / 3.0])
    spread = (terms @ [max(white, 1e-15) ** 2, walk**2]) * np.sqrt(seconds)
    n2, k2 = nnls(terms / spread[:, None], allan / spread)[0]
    return float(np.sqrt(n2)), float(np.sqrt(k2))


def trials(
    white: float, walk: float, step: float, rate: float, count: int, seed: int = 7
) -> Floats:
    """Return N and K fitted to simulated samples of given densities, shape (n, 2)."""
    generator = np.random.default_rng(seed)
    fits = []
    for _ in range(_TRIALS):
        samples = np.cumsum(generator.standard_normal((count, 3)) * walk / rate**0.5, axis=0)
        samples += generator.standard_normal((count, 3)) * white * rate**0.5
        if step:
            samples = np.rint(samples / step) * step
        fits.append(densities(*variances(samples, rate), white, walk))
    return np.array(fits)


def needed(imu: ImuAnnouncement, most: float) -> float:
    """Return how long an IMU has to stand for its numbers to be shown, seconds, at most `most`."""
    seconds = 60.0
    for name in ("gyroscope", "accelerometer"):
        numbers = _announced(imu, name)
        fits = trials(*numbers, imu.rate, round(60.0 * imu.rate))
        for value, spread in zip(numbers, fits.std(axis=0), strict=False):
            if value:
                seconds = max(seconds, 60.0 * (2.5 * spread / value / ALLOWED) ** 2)
    return min(seconds, most)


def noise(imu: ImuAnnouncement, samples: dict[str, Floats]) -> Iterator[tuple[Curve, list[Figure]]]:
    """Yield curve and figures of each sensor; its samples at rest have the shape (n, 3)."""
    for name, rows in samples.items():
        white, walk, step = _announced(imu, name)
        seconds, allan = variances(rows, imu.rate)
        fitted = densities(seconds, allan, white, walk)
        tried = trials(white, walk, step, imu.rate, len(rows))
        model = np.sqrt(white**2 / seconds + walk**2 * seconds / 3.0)
        names = f"{name}_noise_density", f"{name}_random_walk"
        figures = [
            _figure(imu, *row, len(rows) / imu.rate)
            for row in zip(names, (white, walk), fitted, tried.T, strict=True)
        ]
        yield Curve(name, seconds, np.sqrt(allan), model), figures


def _announced(imu: ImuAnnouncement, name: str) -> tuple[float, float, float]:
    return tuple(
        float(getattr(imu, f"{name}_{kind}"))
        for kind in ("noise_density", "random_walk", "resolution")
    )  # type: ignore[return-value]


def _figure(
    imu: ImuAnnouncement,
    name: str,
    announced: float,
    value: float,
    expected: Floats,
    seconds: float,
) -> Figure:
    if announced == 0.0:
        limit = 1.5 * float(expected.max()) + 1e-9
        wrong = f"{imu.source}: {name} is {value:.3g}, announced as 0"
        return judged(imu.source, f"{name} where 0 is announced", value, limit, "", wrong)
    middle, spread = float(np.median(expected)), float(expected.std()) / announced
    off = abs(value / middle - 1.0) if middle else float("inf")
    limit, remark = ALLOWED, ""
    if 2.0 * spread > ALLOWED:
        limit = max(4.0 * spread, ALLOWED)
        remark = (
            f"{imu.source}: {seconds:.0f} s show {name} to ±{200 * spread:.0f} % only; "
            f"10 % would take some {seconds * (2.0 * spread / ALLOWED) ** 2:.0f} s"
        )
    if off > limit:
        measured = announced * value / middle if middle else value
        remark = (
            f"{imu.source}: {name} is {measured:.3g} by its Allan deviation, "
            f"announced {announced:.3g}"
        )
    return Figure(imu.source, f"{name} beside {announced:.3g}", off, limit, "of it", remark)
