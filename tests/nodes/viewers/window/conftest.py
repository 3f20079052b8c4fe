"""The display that tests of windows share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.nodes.viewers.window.display import MISSING, Display


@pytest.fixture(scope="module")
def display(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Display]:
    if MISSING:
        pytest.skip(f"needs {' and '.join(MISSING)}: apt-get install xvfb xdotool")
    server = Display(tmp_path_factory.mktemp("display"))
    yield server
    server.close()
