"""The table of readers, from entry points, and the reading of whatever a user names.

A package's own reader is an object `Reader`, or several, under the entry point group
``visnav.readers``. Those of other packages are asked first, and one that fails is named, once, and
left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nodes.judging.readers.axes import AXES, Axes, AxesName
from nodes.judging.readers.columns import read_named
from nodes.judging.readers.files import refuse
from nodes.judging.readers.source import Floats, Options, Reader, Source, Start
from nodes.judging.readers.topics import bags_in
from nodes.trajectory import Trajectory
from runtime.errors import CommandError
from runtime.extras import OURS, READERS, Offer, offers
from runtime.run.results import newest, run_folder
from runtime.time.clock import SECOND

_LONGEST_STEP = 10 * 86_400 * SECOND  # more are stamps of different units or clocks
_complaints: dict[str, str] = {}  # by package and name of the entry point


def readers() -> tuple[Reader, ...]:
    """Return the table: other packages' rows first, then our own."""
    return tuple(reader for _, rows in _loaded() for reader in rows)


def complaints() -> list[str]:
    """Return a sentence for each reader of another package that failed."""
    return [*_complaints.values()]


@cache
def _loaded() -> tuple[tuple[Offer, tuple[Reader, ...]], ...]:
    loaded = []
    for offer in sorted(offers(READERS), key=lambda offer: offer.package == OURS):
        try:
            loaded.append((offer, _rows(offer, offer.load())))
        except CommandError as error:
            if offer.package == OURS:
                raise
            _complaints[f"{offer.package}:{offer.name}"] = f"reader left out: {error}"
    return tuple(loaded)


def _rows(offer: Offer, loaded: Any) -> tuple[Reader, ...]:
    if isinstance(loaded, type):  # of a data set, for `Replay`
        return ()
    rows = (loaded,) if isinstance(loaded, Reader) else loaded
    if isinstance(rows, Iterable):
        rows = tuple(rows)
        if all(isinstance(row, Reader) for row in rows):
            return rows
    raise CommandError(
        f"{offer.name} of the package {offer.package}: expected a Reader or several, found "
        f"{type(loaded).__name__}"
    )


def _matching(path: Path, start: Start | None) -> tuple[Offer, Reader] | None:
    for offer, rows in _loaded():
        for reader in rows:
            try:
                if reader.matches(path, start):
                    return offer, reader
            except Exception as error:
                if offer.package == OURS:
                    raise
                _blame(offer, reader, error)
    return None


def _blame(offer: Offer, reader: Reader, error: Exception) -> str:
    what = " ".join(str(error).split()) or type(error).__name__
    text = f"reader left out: {reader.name} of the package {offer.package}: {what}"
    _complaints.setdefault(f"{offer.package}:{offer.name}:{reader.name}", text)
    return text


def read(
    text: str,
    axes: AxesName | None = None,
    times: str = "",
    camera: Floats | None = None,
    *,
    columns: str = "",
) -> Source:
    """Read a trajectory: a file, a topic as ``BAG:/TOPIC``, or a run with one estimator.

    Args:
        text: Its place, after an optional ``NAME=``.
        axes: Those of world and body, instead of what the source declares.
        times: File of the stamps of poses without any.
        camera: Transform from the optical frame to the truth's body, shape (4, 4), if the poses are
            a camera's; the body's axes are then the truth's.
        columns: Meaning of a text file's columns.

    Raises:
        OSError: A file is not there.
        ValueError: It cannot be read; the message names file and line, or pose.
    """
    name, equals, place = text.partition("=")
    if not equals or Path(text).exists():
        name, place = "", text
    path, part = _split(place)
    path = newest(path)
    if (path / "trajectories").is_dir():
        path, usual = _estimate_of(path), AXES["ned"]
    else:
        usual = Axes()
    source = _read(path, Options(part=part, times=times, columns=columns))
    declared = AXES[axes] if axes else source.axes if source.axes != Axes() else usual
    source = msgspec.structs.replace(
        source, name=name or source.name or path.stem, file=place, axes=declared
    )
    _check_steps(source)
    return source if camera is None else of_body(source, camera)


def read_truth(
    text: str, times: str = "", axes: AxesName | None = None, *, columns: str = ""
) -> Source:
    """Read true poses of a file, a topic, or a run's folder; a `ValueError` names the line."""
    path = newest(Path(text))
    truth_file = path / "trajectories" / "truth.tum"
    if not truth_file.is_file():
        if path.is_dir() and not _is_known(path):
            run_folder(path)  # raises, of a folder that is none
            truth_file.stat()
        source = read(text, axes, times, columns=columns)
        if changes := source.counts.get("restarts"):
            raise ValueError(
                f"{text}: expected a truth in one frame, found that it changes ({changes} times)"
            )
        return source
    source = read(str(truth_file), axes or "ned", times, columns=columns)
    return msgspec.structs.replace(source, frame_id="map", file=text)


def _is_known(path: Path) -> bool:
    return _matching(path, None) is not None


def _split(text: str) -> tuple[Path, str]:
    """Return the path and what stands after it and a colon: the longest path that is there."""
    places = [k for k, letter in enumerate(text) if letter == ":"]
    for place in (len(text), *reversed(places)):
        if Path(text[:place]).exists():
            return Path(text[:place]), text[place + 1 :]
    bag, colon, _ = text.rpartition(":/")
    return Path(bag if colon else text), ""


def _estimate_of(run: Path) -> Path:
    """Return the file of a run's only estimate; a `ValueError` names those that there are."""
    files = sorted((run / "trajectories").glob("*.tum"))
    files = [path for path in files if path.name.partition(".")[0] not in {"truth", "plan"}]
    if len(files) == 1:
        return files[0]
    names = ", ".join(path.name for path in files) or "none"
    raise ValueError(f"{run / 'trajectories'}: expected one estimate, found {names}: name its file")


def _read(path: Path, options: Options) -> Source:
    start = None if path.is_dir() else Start.of(path)
    if options.columns and start is not None and not bags_in(path):
        _check_part(path, options, "named columns", "")
        return read_named(path, options)
    match = _matching(path, start)
    if match is None:
        if path.is_dir():
            names = ", ".join(sorted(file.name for file in path.iterdir())[:8]) or "nothing in it"
            raise ValueError(
                f"{path}: expected a trajectory, a bag or the folder of a run, found a folder with "
                f"{names}"
            )
        refuse(path, start)
    offer, reader = match
    _check_part(path, options, reader.name, reader.part)
    try:
        return reader.read(path, options)
    except (ValueError, OSError):
        raise
    except Exception as error:
        if offer.package == OURS:
            raise
        raise ValueError(f"{path}: {_blame(offer, reader, error)}") from error


def _check_part(path: Path, options: Options, name: str, part: str) -> None:
    if options.part and not part:
        raise ValueError(
            f"{path}: expected nothing after a file of one trajectory ({name}), found "
            f"{options.part!r}"
        )


def _check_steps(source: Source) -> None:
    stamps = source.poses.stamps
    if far := np.flatnonzero(np.diff(stamps) > _LONGEST_STEP).tolist():
        before, after = (stamps[far[0] + k] / SECOND for k in (0, 1))
        raise ValueError(
            f"{source.file}: pose {far[0] + 2}: expected stamps of one unit and one clock, found "
            f"{after:.3f} s after {before:.3f} s"
        )


def of_body(source: Source, camera: Floats) -> Source:
    """Return the poses of the truth's body, from those of a camera at a place in it.

    Raises:
        ValueError: The camera is not at the body's origin, and its poses have no orientations.
    """
    if source.positions_only and camera[:3, 3].any():
        raise ValueError(
            f"{source.file}: expected orientations, without which the body's position does not "
            "follow from the camera's (--body-from-camera), found positions only"
        )
    matrices = source.poses.matrices() @ np.linalg.inv(camera)
    notes = source.notes
    left = {"covariances": source.covariances, "velocities": source.velocities}
    if names := " and ".join(name for name, values in left.items() if values is not None):
        notes = (*notes, f"left out: {names}, which are of the camera's pose")
    return msgspec.structs.replace(
        source,
        poses=Trajectory.from_matrices(source.poses.stamps, matrices),
        axes=Axes(source.axes.world),
        usual=Axes(source.usual.world),
        covariances=None,
        velocities=None,
        notes=notes,
        lever=tuple(camera[:3, 3].tolist()),
    )
