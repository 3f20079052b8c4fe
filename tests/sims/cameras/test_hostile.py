"""No number of a scene makes the rasteriser overflow, divide by zero, or read beyond its memory."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[3] / "sims" / "cameras" / "rasteriser"
COMPILER = "g++"
# All in one, and not optimized: that is compiled in the shortest time.
FLAGS = ["-std=c++17", "-O0", "-g1", "-fPIC", "-shared", "-pthread", "-ffp-contract=off", "-w"]
CHECKS = "-fsanitize=address,undefined,float-cast-overflow,float-divide-by-zero"
SCENES = 320


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_hostile_scenes_are_drawn_without_a_report_of_the_sanitizers(tmp_path: Path) -> None:
    """With the bytes of the installed builds: what is undefined may differ from one to another."""
    if shutil.which(COMPILER) is None:
        pytest.skip(f"needs {COMPILER}")
    runtimes = [
        subprocess.run(
            [COMPILER, f"-print-file-name={name}"], capture_output=True, text=True, check=True
        ).stdout.strip()
        for name in ("libasan.so", "libubsan.so", "libstdc++.so")
    ]
    if not all(Path(path).is_absolute() for path in runtimes):
        pytest.skip(f"needs the sanitizers' runtimes of {COMPILER}")
    library, everything = tmp_path / "checked.so", tmp_path / "everything.cpp"
    includes = [f'#include "{source}"\n' for source in sorted(SOURCES.glob("*.cpp"))]
    everything.write_text("".join(includes), encoding="utf-8")
    subprocess.run(
        [COMPILER, *FLAGS, CHECKS, "-DRASTER_CHECKED", str(everything), "-o", str(library)],
        check=True,
    )
    code = library.read_bytes()
    assert b"__ubsan_handle_float_cast_overflow" in code
    assert b"__asan_report_load4" in code
    done = subprocess.run(
        [sys.executable, "-m", "tests.sims.cameras.hostile", str(library), "0", str(SCENES)],
        cwd=Path(__file__).parents[3],
        env={
            **os.environ,
            # Before all else, or what the program has allocated by then is not known to them.
            "LD_PRELOAD": f"{runtimes[0]} {runtimes[2]}",
            "ASAN_OPTIONS": "detect_leaks=0",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    reports = re.findall(r"scene \d+\n(?!scene \d+\n).+", done.stderr)
    assert not reports, "\n".join(reports)
    assert done.returncode == 0, done.stderr[-4000:]
    assert f"scene {SCENES - 1}\n" in done.stderr
