"""What a run knows of itself: how long its end may take."""

from __future__ import annotations

from unittest import mock

import pytest

from runtime import Node
from runtime.run import run_state
from runtime.testing import spec
from tests.runtime.samples_runs import supervise, supervisor_of


@pytest.mark.parametrize(
    ("simulated", "real", "limit"), [(0, 0, 4.0), (100, 0, 9.0), (100, 200, 14.0)]
)
def test_the_limit_of_an_end_grows_by_a_twentieth_of_the_longer_time(
    simulated: int, real: int, limit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = []

    class Asks(Node):
        async def on_startup(self) -> None:
            self.ask()

        async def run(self) -> None:
            await self.clock.sleep(simulated)
            wall, state = mock.Mock(), supervisor_of(self).state
            assert state.first_update is not None
            wall.monotonic.return_value = state.first_update + real
            with monkeypatch.context() as patch:
                patch.setattr(run_state, "time", wall)
                self.ask()

        def ask(self) -> None:
            limits.append(supervisor_of(self).state.shutdown_limit())

    supervise([spec(Asks, "a")], duration=1000, shutdown_limit=4)
    assert limits == [pytest.approx(4.0), pytest.approx(limit)]
