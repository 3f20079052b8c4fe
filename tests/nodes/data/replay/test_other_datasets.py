"""Data sets that are read by other packages' classes: asked first, and named if they fail."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from events import Odometry, Wind
from nodes.data.replay import datasets
from nodes.data.replay.folders import Dataset, Rows
from nodes.data.replay.node import open_reader
from nodes.data.replay.reader import Choice, ReplayConfig, ReplayError
from runtime.errors import CommandError
from runtime.extras import Offer


class Package(Offer):
    """Entry point of another package, whose object is at hand."""

    loaded: Any = None

    def load(self) -> Any:
        if isinstance(self.loaded, Exception):
            raise self.loaded
        return self.loaded


class Mine(Dataset):
    """A data set that is a single file of winds, and a path."""

    layout = "mine (.mine)"

    @classmethod
    def find(cls, path: Path) -> Path | None:
        return path if path.suffix == ".mine" else None

    def load(self) -> None:
        winds = [(k * 10, (float(k), 0.0, 0.0)) for k in range(5, 8)]
        self.others.append(Rows(Wind, "wind", winds, self._wind))
        self.truth = [(0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))] * 3
        self.truth += [(60, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0))]

    def _wind(self, stamp: int, velocity: Any) -> Wind:
        return Wind(stamp=stamp, source="wind", velocity=velocity)


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[Package]:
    offer = Package("their-data", "mine", "theirs:Mine")
    offer.loaded = Mine
    for module in ("datasets", "node"):
        monkeypatch.setattr(f"nodes.data.replay.{module}.others", lambda _: (offer,))
    datasets._other_readers.cache_clear()
    yield offer
    datasets._other_readers.cache_clear()


@pytest.mark.parametrize("folder", [True, False])
def test_a_packages_reader_gives_files_and_folders(
    package: Package, tmp_path: Path, folder: bool
) -> None:
    path = tmp_path / "a.mine"
    path.mkdir() if folder else path.touch()
    reader = open_reader(ReplayConfig(file=str(path)), "drone")
    events = [timed.event for timed in reader.events(0, None, Choice(("Event",)))]
    # A pose before the first wind is kept: the run begins with it.
    assert [(type(event), event.stamp) for event in events] == [
        *((Odometry, 0), (Wind, 50), (Wind, 60), (Odometry, 60), (Wind, 70)),
    ]
    assert isinstance(events[3], Odometry)
    assert events[3].linear_velocity == (2.0, 0.0, 0.0)
    (vehicle,) = reader.announcements()
    assert vehicle.source == "drone"


def test_what_it_does_not_know_is_read_as_before(package: Package, tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match=r"a data set of mine \(\.mine\), EuRoC's .* or KITTI's"):
        open_reader(ReplayConfig(file=str(tmp_path)), "drone")
    package.loaded = ["a row for judge"]
    datasets._other_readers.cache_clear()
    with pytest.raises(ReplayError, match=r"a data set of EuRoC's"):
        open_reader(ReplayConfig(file=str(tmp_path)), "drone")


def test_a_calibration_needs_a_reader_that_heeds_it(package: Package, tmp_path: Path) -> None:
    path = tmp_path / "a.mine"
    path.mkdir()
    with pytest.raises(ReplayError, match=r"calibration: expected .*, found one in mine"):
        open_reader(ReplayConfig(file=str(path), calibration=("imu.yaml",)), "drone")


@pytest.mark.parametrize(
    ("loaded", "message"),
    [
        (CommandError("mine of the package their-data: …"), "^mine of the package their-data"),
        (Dataset, "mine of the package their-data: expected a class derived from .*found Dataset"),
        (Path, "mine of the package their-data: expected a class derived from .*found Path"),
        (type("Torn", (Mine,), {"find": None}), "mine of the package their-data cannot read it"),
    ],
)
def test_a_packages_reader_that_fails_is_named(
    package: Package, tmp_path: Path, loaded: Any, message: str
) -> None:
    package.loaded = loaded
    with pytest.raises(ReplayError, match=message):
        open_reader(ReplayConfig(file=str(tmp_path)), "drone")
