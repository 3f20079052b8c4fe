"""``export``: a run's trajectories, measurements and calibration, as files for other tools."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class Format(Enum):
    """What ``--format`` takes."""

    tum = "tum"
    euroc = "euroc"
    kitti = "kitti"
    csv = "csv"
    kalibr = "kalibr"
    openvins = "openvins"
    vins = "vins"
    basalt = "basalt"
    orbslam3 = "orbslam3"
    vslamlab = "vslamlab"


def export(
    run: Annotated[Path, typer.Argument(help="The folder of a run: runs/<name>.")],
    form: Annotated[Format, typer.Option("--format", "-f", help="Format of the files.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the files; if not given RUN/export, of a calibration "
            "RUN/export/FORMAT."
        ),
    ] = None,
    epoch: Annotated[
        str, typer.Option(help="The run's time 0: a date, or nanoseconds of Unix time.")
    ] = "2020-01-01T00:00:00Z",
    camera: Annotated[
        str | None,
        typer.Option(help="Of a calibration: a camera, or a vehicle; the first if not given."),
    ] = None,
) -> None:
    """Write a run's trajectories, measurements or calibration, as other tools read them.

    tum, euroc and kitti are the true and the estimated trajectories, as evo reads them.
    tum and euroc give one file each for the truth and every estimator; euroc adds the estimates
    in TUM's format, which is what evo_ape euroc compares with, and turns all to a world with z
    up. kitti has no stamps, so it gives a pair of files for every estimator, pose by pose: those
    of the first camera, from identity.

    csv gives what IMU, barometer, magnetometer, satellite receiver and range finders measured, and
    the wind: a file each, if the run has a recording.

    The others are calibrations: cameras, IMU and the transforms between them, as that program's
    files say it: kalibr, openvins, vins (VINS-Fusion), basalt, orbslam3, and vslamlab, which also
    gets images, IMU data and ground truth if the run has a recording. A lens that a format has no
    word for is refused.
    """
    from nodes.calibration.export import export_calibration
    from nodes.data.export import trajectories as exports
    from nodes.data.export.measurements import export_measurements
    from runtime.errors import ConfigError

    try:
        if form.value in exports.FORMATS:
            written = exports.export(run, form.value, out, epoch)
        elif form is Format.csv:
            written = export_measurements(run, out, epoch)
        else:
            written = export_calibration(run, form.value, out, epoch, camera)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    for path in written:
        print(path)
