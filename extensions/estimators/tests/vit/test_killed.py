"""A library that is killed at a random frame ends the run with one error, and loses nothing."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from extensions.estimators.tests.vit.library import stub_settings
from tests.nodes.outside.process.killing import SIGNALS, kill
from tests.nodes.outside.process.test_killed import RIG

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_run_whose_library_is_killed_names_it_and_loses_nothing(
    number: signal.Signals, tmp_path: Path
) -> None:
    given = stub_settings("delay 2")
    settings = "".join(f'{name} = "{value}"\n' for name, value in given.items())
    text = f'name = "vio"\ntype = "Vit"\nmode = "monocular_inertial"\n{settings}'
    kill(RIG + text, given["library"], "vio", number, tmp_path / "killed")
