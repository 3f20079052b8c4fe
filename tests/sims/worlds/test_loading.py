"""Worlds are found by name or path; what is wrong is said."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from sims.worlds import TOURS, WORLDS, WorldError, load_world


def test_every_world_has_a_tour() -> None:
    """The tours' names are the worlds' names."""
    assert set(TOURS) == set(WORLDS)


def test_a_file_is_a_world(tmp_path: Path) -> None:
    """A user's MJCF loads by path, as text or as a Path."""
    file = tmp_path / "mine.xml"
    file.write_text("<mujoco><worldbody><geom name='g' size='1'/></worldbody></mujoco>")
    for place in (file, str(file)):
        spec = load_world(place)
        assert isinstance(spec, mujoco.MjSpec)
        assert spec.geom("g") is not None


def test_an_unknown_name_gets_near_ones_suggested() -> None:
    """The message has what was found, what there is and what may have been meant."""
    with pytest.raises(WorldError, match=r'of corridor, forest.*found "hal"; did you mean hall\?'):
        load_world("hal")
    with pytest.raises(WorldError, match=r'found "moon"$'):
        load_world("moon")


def test_missing_and_broken_files_are_told_apart(tmp_path: Path) -> None:
    """Nothing there, a directory, no XML, and XML that doesn't compile."""
    with pytest.raises(WorldError, match=r"none\.xml: expected an MJCF file, found nothing"):
        load_world(tmp_path / "none.xml")
    with pytest.raises(WorldError, match="found a directory"):
        load_world(tmp_path)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>")
    with pytest.raises(WorldError, match=r"broken\.xml: expected an MJCF file that compiles.*XML"):
        load_world(broken)
    broken.write_text("<mujoco><worldbody><geom type='mesh' mesh='x'/></worldbody></mujoco>")
    with pytest.raises(WorldError, match=r"broken\.xml: .*mesh"):
        load_world(str(broken))
