"""A finished run's calibration, and its data where the format has a place for it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import msgspec

import events
from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
)
from nodes.calibration.formats import DEPTH_FACTOR, write_files
from nodes.calibration.sequence import VslamLab
from nodes.dataset.rig import choose
from nodes.trajectory.table import EPOCH, epoch_of


def export_calibration(
    run: Path,
    form: str,
    out: Path | None = None,
    epoch: int | str = EPOCH,
    camera: str | None = None,
) -> list[Path]:
    """Write what a run announced of its cameras and its IMU as another program's calibration.

    ``vslamlab`` also gets images, IMU and ground truth, if the run has a recording.

    Args:
        run: The run's folder.
        form: One of `nodes.calibration.formats.FORMATS`.
        out: Folder for the files; ``export/<form>`` in the run's folder if None.
        epoch: The run's time 0 in the data: a date (ISO 8601), or nanoseconds of Unix time.
        camera: Source of a camera, or of the body whose cameras are wanted; the first camera's
            body if None.

    Returns:
        What was written.

    Raises:
        ValueError: The run left no announcements, it has no such camera, or the format has no word
            for it.
        OSError: A file cannot be written.
    """
    zero = epoch_of(epoch)
    rig = choose(announcements(run), camera)
    files = write_files(rig, form)
    folder = out or run / "export" / form
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    written = [folder / name for name in files]
    recording = run / "recording.mcap"
    if form != "vslamlab" or not recording.is_file():
        return written
    from nodes.replay.recorded import Recorded  # which wants what reads MCAP

    for number in range(len(rig.cameras)):
        for kind in ("rgb", "depth"):
            shutil.rmtree(folder / f"{kind}_{number}", ignore_errors=True)
    reader, sequence = Recorded(recording), VslamLab(folder, rig, DEPTH_FACTOR, zero)
    wanted = (Image, DepthImage, Imu, Odometry)
    take: dict[type[Any], Any] = {Imu: sequence.imu, Odometry: sequence.odometry}
    for _, event in reader.events(0, None, lambda kind, _: issubclass(kind, wanted)):
        if type(event) in take:
            take[type(event)](event)
        elif isinstance(event, Image | DepthImage) and (file := sequence.note(event)) is not None:
            file()
    reader.close()
    sequence.close()
    return written + [file.path for file in sequence.files]


def announcements(run: Path) -> list[Announcement]:
    """Return what a run announced of its cameras and IMUs: they stand in its summary.

    Raises:
        ValueError: It left none, as a run that was killed does.
    """
    path = run / "summary.json"
    try:
        found = msgspec.json.decode(path.read_bytes())["announcements"]
        return [
            msgspec.convert(
                {key: value for key, value in each.items() if key != "type"},
                getattr(events, each["type"]),
            )
            for each in found
            if each["type"] in {CameraAnnouncement.__name__, ImuAnnouncement.__name__}
        ]
    except (OSError, KeyError, TypeError, msgspec.MsgspecError) as error:
        raise ValueError(
            f"{path}: expected the summary of a finished run with what it announced, found: {error}"
        ) from None
