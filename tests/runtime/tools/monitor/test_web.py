"""The page's server, asked as a browser would, and as one would not."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from runtime.tools.monitor.protocol import Pause, Set
from runtime.tools.monitor.web import Page, page_data
from tests.runtime.tools.monitor.samples import FakeClient, snapshot

TOKEN = "abc"


@asynccontextmanager
async def serving(stand: FakeClient) -> AsyncIterator[int]:
    page = Page(stand, TOKEN)  # type: ignore[arg-type]  # it stands for a client
    server = await asyncio.start_server(page.serve, "127.0.0.1", 0)
    listening = asyncio.create_task(page.listen())
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        stand.coming.put_nowait(None)
        await listening
        server.close()
        await server.wait_closed()


async def say(port: int, request: str, body: str = "") -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"{request.replace('PORT', str(port))}\r\n\r\n{body}".encode())
    answer = await asyncio.wait_for(reader.read(), 5)
    writer.close()
    return answer.decode(errors="surrogateescape")


def get(path: str, host: str = "127.0.0.1:PORT") -> str:
    return f"GET {path} HTTP/1.1\r\nHost: {host}"


def post(body: str, token: str = TOKEN) -> str:
    return (
        f"POST /command HTTP/1.1\r\nHost: localhost:PORT\r\nX-Token: {token}\r\n"
        f"Content-Length: {len(body)}"
    )


async def test_the_page_comes_with_the_token_and_runs_no_script_but_its_own() -> None:
    async with serving(FakeClient()) as port:
        page = await say(port, get(f"/?token={TOKEN}"))
    head, _, content = page.partition("\r\n\r\n")
    assert head.startswith("HTTP/1.1 200")
    assert "script-src 'nonce-" in head
    assert '<section id="outputs"' in content
    assert "http://" not in content
    assert "https://" not in content


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (get("/"), 403),
        (get("/?token=abd"), 403),
        (get("/?token=é"), 403),
        (get(f"/?token={TOKEN}", host="evil.example"), 403),
        (get(f"/?token={TOKEN}") + "\r\nHost: evil.example", 400),
        (get(f"/?token={TOKEN}", host="evil.example") + "\r\nHost: localhost", 400),
        (get(f"/nothing?token={TOKEN}"), 404),
        (f"PUT /?token={TOKEN} HTTP/1.1\r\nHost: localhost", 405),
        ("nonsense", 400),
        ("GET http://[ HTTP/1.1\r\nHost: localhost", 400),
        (get("/image"), 403),
        (get(f"/image?token={TOKEN}"), 404),
        (get(f"/image?token={TOKEN}&camera=drone.depth"), 404),
        (get("/") + "\r\nContent-Length: many", 400),
        (get("/") + "\r\nContent-Length: 9999999", 413),
        (get("/") + "\r\nContent-Length: " + "9" * 5000, 413),
        (get("/") + "\r\nX: " + "x" * 100_000, 413),
    ],
)
async def test_whoever_should_not_is_sent_away(request_: str, status: int) -> None:
    async with serving(FakeClient()) as port:
        assert (await say(port, request_)).startswith(f"HTTP/1.1 {status} ")


async def test_the_page_shows_at_once_what_is_known() -> None:
    stand = FakeClient(snapshot())
    async with serving(stand) as port:
        await say(port, get(f"/?token={TOKEN}"))
        page = await say(port, get(f"/?token={TOKEN}"))
    assert (
        'const first = {"cameras": ["drone.images: drone/front"], "fixed": "", "headline": "sample '
        in page
    )
    assert "[b]wind[/b]" in page


async def test_the_image_of_the_chosen_camera_is_served() -> None:
    async with serving(FakeClient(snapshot())) as port:
        camera = "drone.images:%20drone/front"
        head, _, jpeg = (await say(port, get(f"/image?token={TOKEN}&camera={camera}"))).partition(
            "\r\n\r\n"
        )
    assert head.startswith("HTTP/1.1 200")
    assert "content-type: image/jpeg" in head
    assert "cache-control: no-store" in head
    assert jpeg.endswith("a JPEG")


async def test_commands_go_to_the_run_if_they_bear_the_token() -> None:
    stand = FakeClient()
    async with serving(stand) as port:
        for body in ('{"do":"pause"}', '{"do":"set","text":"pilot.gain=2"}'):
            answer = (await say(port, post(body), body)).partition("\r\n\r\n")[2]
            assert json.loads(answer)["text"] == "done"
        assert "403" in await say(port, post('{"do":"stop"}', token="x"), '{"do":"stop"}')
        refused = await say(port, post('{"do":"explode"}'), '{"do":"explode"}')
        assert refused.startswith("HTTP/1.1 400")
        assert "expected a command" in refused
    assert stand.asked == [Pause(), Set(text="pilot.gain=2")]


async def test_snapshots_come_as_events_and_so_does_the_end() -> None:
    stand = FakeClient(snapshot())
    async with serving(stand) as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"{get(f'/events?token={TOKEN}')}\r\n\r\n".replace("PORT", "1").encode())

        async def event() -> Any:
            line = await reader.readuntil(b"\n\n")
            return json.loads(line.partition(b"data: ")[2])

        assert b"text/event-stream" in await reader.readuntil(b"\r\n\r\n")
        first = await event()
        stand.coming.put_nowait(snapshot(clock_now=2.0))
        second = await event()
        stand.coming.put_nowait(None)
        assert await event() == {"over": "the run is over: it does not answer any more"}
        assert await reader.read() == b""
        writer.close()
    assert first["headline"].startswith("sample   1.500")
    assert second["headline"].startswith("sample   2.000")
    assert second["tables"]["nodes"][0][0] == "drone"
    assert second["cameras"] == ["drone.images: drone/front"]
    settings = [["pilot.gain", "1.0"], ["pilot.patience", "0.5"]]
    assert second["tables"]["settings"] == settings


async def test_a_page_that_is_slow_still_sees_how_it_ended() -> None:
    page = Page(FakeClient(*(snapshot() for _ in range(9)), snapshot(ended="duration"), None))  # type: ignore[arg-type]

    async def look() -> list[bytes]:
        return [event async for event in page._events()]

    looking = asyncio.create_task(look())
    await asyncio.sleep(0)
    await page.listen()
    seen = await looking
    told = [json.loads(each.removeprefix(b"data: ")) for each in seen]
    assert told[-2]["headline"].endswith("ends: duration")
    assert told[-1] == {"over": "the run is over: duration"}


def test_faster_starts_from_a_speed_even_when_time_stands() -> None:
    assert page_data(snapshot(clock_paused=True, clock_speed=0.0))["speed"] == 1.0
    assert page_data(snapshot(clock_target_speed=0.5))["speed"] == 0.5


def test_the_page_needs_no_textual() -> None:
    """In a fresh process, as other tests have imported it."""
    code = "import sys; sys.modules['textual'] = None; import runtime.tools.monitor.web"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[4])
