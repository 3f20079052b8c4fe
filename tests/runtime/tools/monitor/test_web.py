"""The page's server, asked as a browser would, and as one would not."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path

import pytest

from runtime.tools.monitor import web
from runtime.tools.monitor.protocol import (
    Answer,
    Look,
    Pause,
    Request,
    Set,
    Snapshot,
    Watch,
    decode_request,
    encode,
    socket_of,
)
from runtime.tools.monitor.web import PageServer
from tests.runtime.tools.monitor.samples import snapshot

TOKEN = "abc"
JPEG = b"\xff\xd8 a JPEG"


class FakeRun:
    """Answers as a run does: each who watches gets the snapshots, and the end after `None`."""

    def __init__(self, *snapshots: Snapshot | None) -> None:
        self.asked: list[Request] = []
        self.snapshots = snapshots
        self.goes_on = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with closing(writer):
            try:
                request = decode_request(await reader.readline())
            except ValueError:
                writer.write(encode(Answer(done=False, text="expected a command")) + b"\n")
                return
            self.asked.append(request)
            if isinstance(request, Watch):
                for snapshot in self.snapshots:
                    writer.write(encode(snapshot) + b"\n" if snapshot is not None else b"")
                if None not in self.snapshots:
                    await self.goes_on.wait()
            elif isinstance(request, Look) and request.camera != "drone.images: drone/front":
                writer.write(encode(Answer(done=False, text="expected a camera")) + b"\n")
            else:
                jpeg = JPEG if isinstance(request, Look) else b""
                writer.write(encode(Answer(done=True, text="done", jpeg=jpeg)) + b"\n")


@asynccontextmanager
async def serving(run: FakeRun) -> AsyncIterator[int]:
    path = socket_of("sample")
    async with await asyncio.start_unix_server(run.serve, path):
        with PageServer(0, path, TOKEN) as server:
            thread = threading.Thread(target=server.serve_forever, args=(0.01,))
            thread.start()
            try:
                yield server.server_port
            finally:
                run.goes_on.set()
                await asyncio.to_thread(server.shutdown)
                thread.join()


@pytest.fixture(autouse=True)
def _sockets(sockets: Path) -> None: ...


async def say(port: int, request: str, body: str = "") -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"{request.replace('PORT', str(port))}\r\n\r\n{body}".encode())
    answer = await asyncio.wait_for(reader.read(), 5)
    writer.close()
    return answer.decode(errors="surrogateescape")


def get(path: str, host: str = "127.0.0.1:PORT") -> str:
    return f"GET {path} HTTP/1.1\r\nHost: {host}"


def post(body: str, token: str = TOKEN, length: str = "") -> str:
    return (
        f"POST /command HTTP/1.1\r\nHost: localhost:PORT\r\nX-Token: {token}\r\n"
        f"Content-Length: {length or len(body)}"
    )


async def test_the_page_comes_with_the_token_and_runs_no_script_but_its_own() -> None:
    async with serving(FakeRun(snapshot())) as port:
        page = await say(port, get(f"/?token={TOKEN}"))
    head, _, content = page.partition("\r\n\r\n")
    assert head.startswith("HTTP/1.0 200")
    assert "script-src 'nonce-" in head
    assert '<section id="outputs"' in content
    assert "http://" not in content
    assert "https://" not in content


@pytest.mark.slow
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
        (f"PUT /?token={TOKEN} HTTP/1.1\r\nHost: localhost", 501),
        ("nonsense", 400),
        ("GET http://[ HTTP/1.1\r\nHost: localhost", 400),
        (get("/image"), 403),
        (get(f"/image?token={TOKEN}"), 404),
        (get(f"/image?token={TOKEN}&camera=drone.depth"), 404),
        (post("", length="many"), 400),
        (post("", length="9999999"), 413),
        (post("", length="9" * 5000), 413),
        (get(f"/command?token={TOKEN}"), 405),
        (get("/") + "\r\nX: " + "x" * 100_000, 431),
    ],
)
async def test_whoever_should_not_is_sent_away(request_: str, status: int) -> None:
    async with serving(FakeRun(snapshot())) as port:
        answer = await say(port, request_)
    assert answer.startswith(f"HTTP/1.0 {status} ") or f"Error code: {status}" in answer


async def test_the_page_shows_at_once_what_is_known() -> None:
    async with serving(FakeRun(snapshot())) as port:
        page = await say(port, get(f"/?token={TOKEN}"))
    assert 'const first = {"cameras": ["drone.images: drone/front"], "ended": "", ' in page
    assert "[b]wind[/b]" in page


async def test_the_image_of_the_chosen_camera_is_served() -> None:
    async with serving(FakeRun(snapshot())) as port:
        camera = "drone.images:%20drone/front"
        head, _, jpeg = (await say(port, get(f"/image?token={TOKEN}&camera={camera}"))).partition(
            "\r\n\r\n"
        )
    assert head.startswith("HTTP/1.0 200")
    assert "content-type: image/jpeg" in head
    assert "cache-control: no-store" in head
    assert jpeg.endswith("a JPEG")


async def test_commands_go_to_the_run_if_they_bear_the_token() -> None:
    run = FakeRun()
    async with serving(run) as port:
        for body in ('{"do":"pause"}', '{"do":"set","text":"pilot.gain=2"}'):
            answer = (await say(port, post(body), body)).partition("\r\n\r\n")[2]
            assert json.loads(answer)["text"] == "done"
        assert "403" in await say(port, post('{"do":"stop"}', token="x"), '{"do":"stop"}')
        for body in ('{"do":"explode"}', '{"do":\n"pause"}\n{"do":"stop"}'):
            assert "expected a command" in await say(port, post(body), body)
    assert run.asked == [Pause(), Set(text="pilot.gain=2")]


async def test_snapshots_come_as_events_and_so_does_the_end() -> None:
    run = FakeRun(snapshot(), snapshot(ended="duration"), None)
    async with serving(run) as port:
        head, _, body = (await say(port, get(f"/events?token={TOKEN}"))).partition("\r\n\r\n")
    assert "content-type: text/event-stream" in head
    events = [json.loads(event.removeprefix("data: ")) for event in body.strip().split("\n\n")]
    assert events == [
        json.loads(encode(snapshot())),
        json.loads(encode(snapshot(ended="duration"))),
        None,
    ]
    assert run.asked == [Watch()]


async def test_a_page_of_a_run_that_is_over_says_so(sockets: Path) -> None:
    run = FakeRun()
    async with serving(run) as port:
        socket_of("sample").unlink()
        assert "data: null" in await say(port, get(f"/events?token={TOKEN}"))
        answer = await say(port, post('{"do":"pause"}'), '{"do":"pause"}')
    assert "expected a run that listens at" in answer


async def test_nobody_watches_a_run_whose_page_is_not_open() -> None:
    run = FakeRun(snapshot())
    async with serving(run):
        pass
    assert run.asked == []


def test_a_page_is_served_until_the_run_is_over(
    sockets: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.tools.monitor.web.time.sleep", lambda _: None)
    path = socket_of("sample")
    with socket.socket(socket.AF_UNIX) as run:
        run.bind(str(path))
        run.listen()
        threading.Thread(target=lambda: run.accept()[0].close()).start()
        web.serve(PageServer(0, path, TOKEN))
    assert "the monitor is at http://127.0.0.1:" in capsys.readouterr().out


@pytest.mark.slow
def test_the_page_needs_no_textual() -> None:
    """In a fresh process, as other tests have imported it."""
    code = "import sys; sys.modules['textual'] = None; import runtime.tools.monitor.web"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[4])
