"""Make an image of a recording in Rerun: `python tools/viewer_image.py RRD PNG`.

Serves the recording on this machine, opens it in a headless Chromium (which renders in software,
so it takes a few minutes), and waits until the image no longer changes.
"""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image
from websockets.sync.client import ClientConnection, connect

from visnav_rerun.sdk import program

WIDTH, HEIGHT = 1440, 900
TOP = 32  # height of the viewer's own bar, cut off, pixels
TIMEOUT = 240.0  # seconds until the image must be there
STILL = 4  # number of equal captures in a row, two seconds apart, for a still page

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


def main(recording: str, out: str) -> None:
    """Make the image."""
    with serving(Path(recording)) as address, browser() as page:
        page.call("Emulation.setEmulatedMedia", features=[_DARK])
        page.call("Page.navigate", url=address)
        png = page.still()
    image = Image.open(io.BytesIO(png)).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    image.save(out, optimize=True)
    print(f"{out}: {Path(out).stat().st_size / 1e3:.0f} kB")


@contextmanager
def serving(recording: Path) -> Iterator[str]:
    """Serve a recording, and yield the address of its page."""
    if not recording.is_file():
        raise SystemExit(
            f"expected a recording, found none at {recording}: run with the view first"
        )
    data, web = free_port(), free_port()
    command = [program(), "--serve-web", "--bind", "127.0.0.1", "--port", str(data)]
    command += ["--web-viewer-port", str(web), str(recording)]
    server = subprocess.Popen(  # noqa: S603  # the library's own program
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    query = urllib.parse.urlencode({"url": f"rerun+http://127.0.0.1:{data}/proxy"})
    try:
        yield f"http://127.0.0.1:{web}?{query}"
    finally:
        server.terminate()
        server.wait()


@contextmanager
def browser() -> Iterator[Page]:
    """Start a browser, and yield its page."""
    program = next((path for name in CHROMIUM if (path := shutil.which(name))), None)
    if program is None:
        raise SystemExit(f"expected one of {', '.join(CHROMIUM)}, found none")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(  # noqa: S603  # the browser
            [
                *(program, "--headless=new", "--no-sandbox", "--remote-debugging-port=0"),
                *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
                *(f"--user-data-dir={profile}", f"--window-size={WIDTH},{HEIGHT}", "about:blank"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            port = _debugging_port(Path(profile) / "DevToolsActivePort")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                pages = json.load(answer)
            url = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
            with connect(url, max_size=None, open_timeout=30) as connection:
                yield Page(connection)
        finally:
            process.terminate()
            process.wait()


class Page:
    """A page of a browser, by Chrome's DevTools protocol."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._calls = 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method and return its result."""
        self._calls += 1
        message = {"id": self._calls, "method": method, "params": parameters}
        self._connection.send(json.dumps(message))
        while True:
            answer = json.loads(self._connection.recv(timeout=TIMEOUT))
            if answer.get("id") == self._calls:
                if "error" in answer:
                    raise SystemExit(f"{method}: {answer['error']['message']}")
                result: dict[str, Any] = answer["result"]
                return result

    def still(self) -> bytes:
        """Return the page as PNG, once still."""
        clip = {"x": 0, "y": TOP, "width": WIDTH, "height": HEIGHT - TOP, "scale": 1}
        self.call("Emulation.setDeviceMetricsOverride", **_SCREEN)
        end, last, equal = time.monotonic() + TIMEOUT, b"", 0
        while equal < STILL:
            if time.monotonic() > end:
                print("the image still changes; this is the last of it", file=sys.stderr)
                break
            time.sleep(2.0)
            shot = self.call("Page.captureScreenshot", format="png", clip=clip)["data"]
            png = base64.b64decode(shot)
            equal = equal + 1 if png == last and _is_full(png) else 0
            last = png
        return last


def free_port() -> int:
    """Return a free port of the loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _debugging_port(file: Path) -> int:
    end = time.monotonic() + 30.0
    while time.monotonic() < end:
        if file.is_file() and (match := re.match(r"(\d+)\n", file.read_text())):
            return int(match[1])
        time.sleep(0.1)
    raise SystemExit("expected the browser to start within 30 s")


def _is_full(png: bytes) -> bool:
    return len(png) > 100_000


_DARK = {"name": "prefers-color-scheme", "value": "dark"}
_SCREEN = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    main(sys.argv[1], sys.argv[2])
