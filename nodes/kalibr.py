"""Calibrations in Kalibr's YAML: chains of cameras with their IMU, and the noise of IMUs.

Formats: github.com/ethz-asl/kalibr/wiki/yaml-formats. A chain has a table ``cam0``, ``cam1``, … for
each camera; an IMU is a table ``imu0`` (as Kalibr writes it) or keys without a table (as it reads
it). OpenVINS' files are read, too (docs.openvins.com/gs-calibration.html): ``T_imu_cam`` there is
the inverse of ``T_cam_imu``. Transforms take points of the frame named last to that named first;
optical frames have x right, y down, z forward, an IMU the axes of its measurements.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.camera_info import COEFFICIENTS
from events.geometry import inverse
from runtime.errors import MissingDependencyError
from runtime.extras import install_command

Floats = npt.NDArray[np.float64]

SUFFIXES = (".yaml", ".yml")
_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "equi": "equidistant"}
"""Kalibr's names of distortion models, and ours; ``none`` is a pinhole."""
_NOISE = (
    "accelerometer_noise_density", "accelerometer_random_walk",
    "gyroscope_noise_density", "gyroscope_random_walk",
)  # fmt: skip
_ANGLE, _SHIFT = 1e-2, 1e-2
"""How far T_cn_cnm1 may be from T_cam_imu of two cameras, rad and m: each is an estimate."""
_PER_CAMERA = re.compile(r"cam(\d+)")
_PER_IMU = re.compile(r"imu(\d+)")


class KalibrCamera(msgspec.Struct, frozen=True, eq=False):
    """Camera of a chain."""

    name: str  # ``cam0``
    topic: str  # ``rostopic``; empty if not noted
    info: CameraInfo
    in_imu: Floats | None  # transform to the IMU, (4, 4); None if no camera's place on it is known
    in_first: Floats  # transform to the optical frame of the chain's first camera, (4, 4)
    # Seconds by which images' stamps are late on the IMU's clock: less ``timeshift_cam_imu``.
    time_offset: float


class KalibrImu(msgspec.Struct, frozen=True, eq=False):
    """IMU with its noise (continuous densities), rate (Hz) and place."""

    name: str  # ``imu0``
    topic: str
    rate: float
    accelerometer_noise_density: float  # m/s²/√Hz
    accelerometer_random_walk: float  # m/s³/√Hz
    gyroscope_noise_density: float  # rad/s/√Hz
    gyroscope_random_walk: float  # rad/s²/√Hz


class Chain(msgspec.Struct, frozen=True, eq=False):
    """Cameras and IMUs of one rig, in the order of their numbers; either may be none."""

    where: str  # files, for messages
    cameras: tuple[KalibrCamera, ...]
    imu: KalibrImu | None


def read_chain(paths: Sequence[Path]) -> Chain:
    """Read the files of a rig's calibration, as if they were one.

    Raises:
        ValueError: A file cannot be read, holds something else, or contradicts itself; the message
            names the key.
    """
    where = ", ".join(map(str, paths))
    texts = []
    for path in paths:
        try:
            texts.append(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: expected Kalibr's YAML, found: {error}") from None
    return parse_chain("\n".join(texts), where)


def parse_chain(text: str, where: str) -> Chain:
    """Parse the text of one or more files; a `ValueError` begins with `where`."""
    table = _parse(text, where)
    cameras: list[KalibrCamera] = []
    for name, given in _numbered(table, _PER_CAMERA, where):
        cameras.append(_camera(_Keys(f"{where}: {name}", given), name, cameras))
    if (known := next((c for c in cameras if c.in_imu is not None), None)) is not None:
        assert known.in_imu is not None
        first = known.in_imu @ inverse(known.in_first)
        cameras = [
            msgspec.structs.replace(c, in_imu=first @ c.in_first) if c.in_imu is None else c
            for c in cameras
        ]
    imus = [
        _imu(_Keys(f"{where}: {name}", given), name)
        for name, given in _numbered(table, _PER_IMU, where)
    ]
    if not imus and any(key in table for key in _NOISE):
        imus = [_imu(_Keys(where, table), "imu0")]
    if not cameras and not imus:
        raise ValueError(
            f"{where}: expected Kalibr's calibration of cameras (cam0, …) or of an IMU "
            f"({_NOISE[0]}, …), found {', '.join(map(str, table)) or 'nothing'}"
        )
    return Chain(where, tuple(cameras), imus[0] if imus else None)


def mounting_of_kalibr(text: str) -> Floats | None:
    """Return the transform from a camera's optical frame to the body, that is the IMU, (4, 4).

    Args:
        text: Path of a chain, of its first camera; ``PATH:cam1`` for another one. Or a sensor.yaml
            of EuRoC's, with ``T_BS``.

    Returns:
        None if `text` names no YAML file that exists.

    Raises:
        ValueError: The file has no such camera, or does not say where it is.
    """
    name, camera = text, ""
    if _PER_CAMERA.fullmatch(text.rpartition(":")[2]) and ":" in text:
        name, _, camera = text.rpartition(":")
    path = Path(name)
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return None
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a calibration, found: {error}") from None
    table = _parse(content, name)
    if "T_BS" in table and not camera:
        return transform(table["T_BS"], f"{name}: T_BS")
    cameras = {entry.name: entry for entry in parse_chain(content, name).cameras}
    chosen = cameras.get(camera) if camera else next(iter(cameras.values()), None)
    if chosen is None:
        raise ValueError(
            f"{name}: expected a camera {camera or 'cam0'}, found {', '.join(cameras) or 'none'}"
        )
    if chosen.in_imu is None:
        raise ValueError(
            f"{name}: {chosen.name}: expected T_cam_imu, which says where it is on its body, found "
            "none: that is in the camchain-imucam.yaml of kalibr_calibrate_imu_camera"
        )
    return chosen.in_imu


def transform(given: Any, where: str) -> Floats:
    """Return a rigid transform, (4, 4), given by rows, by 16 numbers or as EuRoC's ``data``.

    Raises:
        ValueError: It is none.
    """
    if isinstance(given, Mapping):
        given = given.get("data")
    try:
        matrix = np.array(given, np.float64).reshape(4, 4)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{where}: expected a transform of 4 × 4 numbers, found {given!r:.80}"
        ) from None
    rigid = np.isfinite(matrix).all() and (matrix[3] == (0.0, 0.0, 0.0, 1.0)).all()
    if not rigid or not is_rotation(matrix[:3, :3]):
        raise ValueError(
            f"{where}: expected a rotation, a translation and a last row 0 0 0 1, "
            f"found {matrix.round(6).tolist()}"
        )
    return matrix


def is_rotation(matrix: Floats) -> bool:
    """Return whether a matrix, (3, 3), is a rotation to 1e-4, as of files with few decimals."""
    odd = abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(odd <= 1e-4 and np.linalg.det(matrix) > 0.0)


class _Keys:
    """Keys of one sensor's table, with errors that name them."""

    def __init__(self, where: str, table: Mapping[str, Any]) -> None:
        self.where, self._table = where, table

    def __contains__(self, key: str) -> bool:
        return self._table.get(key) is not None

    def text(self, key: str) -> str:
        return str(self._table.get(key) or "")

    def number(self, key: str, default: float | None = None) -> float:
        given = self._table.get(key, default)
        try:
            # YAML 1.1 takes 1e-5, which has no point, for a text.
            value = float(given)
        except (TypeError, ValueError, OverflowError):
            self.wrong(key, "a number", given)
        if not np.isfinite(value):
            self.wrong(key, "a finite number", given)
        return value

    def numbers(self, key: str, *counts: int) -> list[float]:
        given = self._table.get(key)
        expected = f"{' or '.join(map(str, counts))} numbers"
        try:
            values = [float(number) for number in given]  # type: ignore[union-attr]
        except (TypeError, ValueError, OverflowError):
            self.wrong(key, expected, given)
        if len(values) not in counts or not np.isfinite(values).all():
            self.wrong(key, expected, given)
        return values

    def transform(self, key: str) -> Floats | None:
        return transform(self._table[key], f"{self.where}: {key}") if key in self else None

    def wrong(self, key: str, expected: str, given: Any) -> NoReturn:
        value = "nothing" if given is None else f"{given!r:.80}"
        raise ValueError(f"{self.where}: {key}: expected {expected}, found {value}")


def _parse(text: str, where: str) -> Mapping[str, Any]:
    # Headers of OpenCV ("%YAML:1.0") are no YAML; of several files only the first could have one.
    try:
        import yaml
    except ImportError:
        raise MissingDependencyError(
            f"{where}: Kalibr's YAML needs pyyaml: {install_command('kalibr')}"
        ) from None
    lines = (line for line in text.splitlines() if not re.match(r"%YAML|---\s*$", line))
    try:
        table = yaml.safe_load("\n".join(lines))
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        what = " ".join(str(error).split())
        raise ValueError(f"{where}: expected YAML, found: {what:.200}") from None
    if not isinstance(table, Mapping):
        raise ValueError(f"{where}: expected Kalibr's YAML, found {table!r:.80}")
    return table


def _numbered(
    table: Mapping[str, Any], name: re.Pattern[str], where: str
) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the tables of sensors in the order of their numbers."""
    numbered = [(int(m[1]), key) for key in table if (m := name.fullmatch(str(key)))]
    for _, key in numbered:
        if not isinstance(table[key], Mapping):
            raise ValueError(f"{where}: {key}: expected a table, found {table[key]!r:.80}")
    return [(key, table[key]) for _, key in sorted(numbered)]


def _camera(keys: _Keys, name: str, before: Sequence[KalibrCamera]) -> KalibrCamera:
    if (model := keys.text("camera_model")) != "pinhole":
        keys.wrong("camera_model", "pinhole (another projection is not supported)", model)
    distortion = keys.text("distortion_model")
    if distortion not in {*_MODELS, "none", ""}:
        keys.wrong("distortion_model", f"one of {', '.join((*_MODELS, 'none'))}", distortion)
    ours = _MODELS.get(distortion, "plumb_bob")
    lens = [0.0] * COEFFICIENTS[ours]
    if distortion in _MODELS:
        given = keys.numbers("distortion_coeffs", *sorted({4, COEFFICIENTS[ours]}))
        lens[: len(given)] = given
    fx, fy, cx, cy = keys.numbers("intrinsics", 4)
    width, height = keys.numbers("resolution", 2)
    if not (fx > 0 and fy > 0):
        keys.wrong("intrinsics", "focal lengths above 0", [fx, fy, cx, cy])
    if not (width >= 1 and height >= 1 and width.is_integer() and height.is_integer()):
        keys.wrong("resolution", "a width and a height in pixels", [width, height])
    from_imu, previous = keys.transform("T_cam_imu"), keys.transform("T_cn_cnm1")
    in_imu = keys.transform("T_imu_cam") if from_imu is None else inverse(from_imu)
    in_first = np.eye(4)
    if before:
        last, first = before[-1], before[0]
        if previous is not None:
            in_first = last.in_first @ inverse(previous)
            if in_imu is None and last.in_imu is not None:
                in_imu = last.in_imu @ inverse(previous)
            elif in_imu is not None and last.in_imu is not None:
                _check_step(keys.where, inverse(in_imu) @ last.in_imu, previous, last.name)
        elif in_imu is not None and first.in_imu is not None:
            in_first = inverse(first.in_imu) @ in_imu
        else:
            keys.wrong("T_cn_cnm1", "the transform from the camera before it", None)
    return KalibrCamera(
        name=name,
        topic=keys.text("rostopic"),
        info=CameraInfo(
            width=int(width),
            height=int(height),
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion_model=ours,  # type: ignore[arg-type]
            distortion=tuple(lens),
        ),
        in_imu=in_imu,
        in_first=in_first,
        time_offset=0.0 - keys.number("timeshift_cam_imu", 0.0),
    )


def _check_step(where: str, by_imu: Floats, by_chain: Floats, last: str) -> None:
    """Raise a `ValueError` if two transforms from the camera before differ beyond their errors."""
    odd = by_chain @ inverse(by_imu)
    skew = odd[:3, :3] - odd[:3, :3].T
    sine = np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]])
    angle = float(np.arctan2(sine, np.trace(odd) - 2.0))
    shift = float(np.linalg.norm(by_chain[:3, 3] - by_imu[:3, 3]))
    if angle > _ANGLE or shift > _SHIFT:
        raise ValueError(
            f"{where}: T_cn_cnm1: expected what T_cam_imu of both cameras gives, T_cam_imu · "
            f"T_cam_imu⁻¹ of {last}, that is {by_imu.round(4).tolist()}, found "
            f"{by_chain.round(4).tolist()}, {np.degrees(angle):.3g}° and {shift:.3g} m from it: "
            "T_imu_cam (as EuRoC's T_BS) may have been given for T_cam_imu"
        )


def _imu(keys: _Keys, name: str) -> KalibrImu:
    noise = {key: keys.number(key) for key in _NOISE}
    for key, value in noise.items():
        if value < 0.0:
            keys.wrong(key, "a density of 0 or more", value)
    rate = keys.number("update_rate", 0.0)
    if rate < 0.0:
        keys.wrong("update_rate", "a rate of 0 or more, Hz", rate)
    return KalibrImu(name=name, topic=keys.text("rostopic"), rate=rate, **noise)
