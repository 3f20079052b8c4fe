"""Make the images of the monitor: `monitor.png` and `web.png` in docs/images.

Starts examples/closed_loop.toml at real speed, looks at it in both ways, and ends it. Needs
Chromium, which draws them.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs" / "images"
SIZE = (150, 46)  # columns and lines of the terminal
FLYING = 20.0  # seconds of the run before the images are made


def main() -> None:
    """Make both images."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        sys.exit("expected chromium, found none")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        command = [
            sys.executable, "-m", "runtime", "run", "examples/closed_loop.toml", "--quiet",
            "--set", "run.speed=1", "--set", "run.stall=0", "--out", f"{folder}/run",
        ]  # fmt: skip
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as run:  # noqa: S603
            try:
                asyncio.run(_look(Path(folder), browser))
            finally:
                run.terminate()


async def _look(folder: Path, browser: str) -> None:
    from runtime.tools.monitor.protocol import Client, Set, runs
    from runtime.tools.monitor.screen import Screen

    deadline = time.monotonic() + 120
    while not (sockets := runs()):
        if time.monotonic() > deadline:
            sys.exit("expected the run to begin within two minutes")
        await asyncio.sleep(0.2)
    path = sockets["closed_loop"]
    client = Client(path)
    screen = Screen(client)
    async with screen.run_test(size=SIZE) as pilot:
        while screen.snapshot is None or screen.snapshot.now < FLYING:
            await pilot.pause(0.2)
        await client.ask(Set(text="pilot.gain=0.8"))
        await pilot.pause(1.0)
        svg = screen.export_screenshot(title="python -m runtime top")
        svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)  # of a server elsewhere
        (folder / "screen.svg").write_text(svg, encoding="utf-8")
        width, height = (round(float(n)) for n in re.findall(r'viewBox="0 0 (\S+) (\S+)"', svg)[0])
        _draw(browser, f"file://{folder}/screen.svg", DOCS / "monitor.png", width, height)
        # The screen still watches: the page shows at once what was seen since.
        web = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "runtime", "web", str(path), "--port", "0",
            cwd=ROOT, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert web.stdout is not None
        url = (await web.stdout.readline()).decode().split()[-1]
        await asyncio.to_thread(_draw, browser, url, DOCS / "web.png", 1360, 1180)
        web.terminate()
        await web.wait()


def _draw(browser: str, url: str, image: Path, width: int, height: int) -> None:
    subprocess.run(  # noqa: S603  # found on the path, and told all it does
        [
            browser, "--headless", "--no-sandbox", "--hide-scrollbars", "--timeout=6000",
            f"--window-size={width},{height}", f"--screenshot={image}", url,
        ],
        check=True, capture_output=True, timeout=60,
        preexec_fn=_stand_back,
    )  # fmt: skip
    print(f"{image}: {image.stat().st_size / 1e3:.0f} kB")


def _stand_back() -> None:
    os.nice(19)  # or the browser would slow down what it shows


if __name__ == "__main__":
    main()
