"""The table of methods in the documentation."""

from __future__ import annotations

import pytest

from sims.airsim.server import AirsimServer
from sims.airsim.server.absent import reason_of_absence
from tests.sims.airsim.methods_table import HEADING, PAGE, rewritten, rows
from tests.sims.airsim.scripts import Caller, drone, with_script


def test_the_page_has_all_methods_as_they_are() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == rewritten(page), "run python -m tests.sims.airsim.methods_table"


def test_the_table_has_what_a_run_serves(tiny_world: str, monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[AirsimServer] = []
    begin = AirsimServer.run

    async def noted(self: AirsimServer) -> None:
        served.append(self)
        await begin(self)

    monkeypatch.setattr(AirsimServer, "run", noted)

    def script(airsim: Caller) -> None:
        assert airsim("ping")

    with_script(script, [drone(world=tiny_world)])
    assert {row.name for row in rows()} == {*served[0].table.methods}
    assert all(row.description.endswith(".") for row in rows())
    assert not any(reason_of_absence(row.name) for row in rows())


def test_a_page_without_the_heading_is_refused() -> None:
    with pytest.raises(ValueError, match=HEADING.strip()):
        rewritten("# Methods")
