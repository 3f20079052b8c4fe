"""Figures of images that are drawn so that they are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from runtime.tools.reality.images import figures_of, main, medians


def spots(*columns: int, grey: float = 200.0) -> npt.NDArray[np.uint8]:
    """Return a black image of 3 x 4 cells, with a blurred spot in some cells of its first row."""
    row, column = np.mgrid[:120, :160]
    image = np.zeros((120, 160))
    for at in columns:
        image += grey * np.exp(-((row - 20) ** 2 + (column - 40 * at - 20) ** 2) / 3.0)
    return image.astype(np.uint8)


def test_a_plain_image_has_nothing() -> None:
    assert figures_of(spots() + np.uint8(90)) == (0, 0, 100.0, 90.0, 0.0, 0.0)


def test_corners_are_counted_by_their_contrast_and_their_cells() -> None:
    strong, weak = figures_of(spots(0, 2)), figures_of(spots(0, 2, grey=12.0))
    assert strong.strong_corners == strong.corners == weak.corners == 2
    assert weak.strong_corners == 0
    assert strong.empty_cells == weak.empty_cells == pytest.approx(100.0 * 10 / 12)


def test_mean_contrast_and_gradient_by_hand() -> None:
    """A ramp of 2 grey levels a pixel, half of an image that is black elsewhere."""
    ramp = np.tile(np.arange(0, 160, 2, dtype=np.uint8), (40, 1))
    assert figures_of(ramp).gradient == pytest.approx(2.0)
    assert figures_of(ramp).mean == pytest.approx(79.0)
    assert figures_of(ramp).contrast == pytest.approx(ramp.std())


def test_folders_are_rows_of_medians(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, image in enumerate((spots(), spots(0), spots(0, 1, 2, 3))):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    row = medians(sorted(tmp_path.glob("*.png")))
    assert row.corners == figures_of(spots(0)).corners
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[1:4] == [
        "3",
        *2 * [f"{row.corners:.0f}"],
    ]


def test_what_is_no_image_or_no_folder_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path)]) == 2
    assert f"{tmp_path}: expected a folder with PNG images, found none" in capsys.readouterr().err
    (tmp_path / "a.png").write_text("no image")
    with pytest.raises(ValueError, match=r"a\.png: expected an image, found something else"):
        medians([tmp_path / "a.png"])
