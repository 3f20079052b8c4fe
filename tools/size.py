"""Size of the product and of its tests: files, lines, and the longest and shortest files."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST, SHORTEST = 500, 80  # limits of a file's lines; a file beyond them needs a reason


def main() -> None:
    """Print a row for each room, and the files too long or too short."""
    command = ["git", "ls-files", "*.py"]
    names = subprocess.check_output(command, cwd=ROOT, text=True).split()  # noqa: S603  # ours
    lines = {name: len((ROOT / name).read_text(encoding="utf-8").splitlines()) for name in names}
    tests = {name for name in names if name.startswith("tests/")}
    product = [name for name in names if name not in tests]
    rooms = sorted({name.partition("/")[0] for name in product if "/" in name})
    for room in rooms:
        _row(room, [lines[name] for name in product if name.startswith(f"{room}/")])
    _row("outside tests", [lines[name] for name in product])
    _row("tests", [lines[name] for name in tests])
    files = [name for name in product if not name.endswith(("__init__.py", "__main__.py"))]
    print(f"above {LONGEST}:", *(n for n in files if lines[n] > LONGEST))
    print(f"below {SHORTEST}:", *(n for n in files if lines[n] < SHORTEST))


def _row(name: str, counts: Iterable[int]) -> None:
    counts = list(counts)
    print(f"{name:14} {sum(counts):7,} lines {len(counts):5} files")


if __name__ == "__main__":
    main()
