"""``demo``, ``example`` and ``new-estimator``: the project's example files, also in a wheel."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from runtime.tools.cli.commands import Overrides, Quiet

SCHEMA = "config.schema.json"
INSTALLED = Path(__file__).parents[1] / "example_files"
CHECKOUT = Path(__file__).parents[3]


def demo(
    out: Annotated[
        Path | None, typer.Option(help="Folder for results; runs/tour/<time> if not given.")
    ] = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Fly the standard tour, and judge visual odometry (config.toml)."""
    from runtime.tools.cli.run import run

    run(example_files()["config"], out=out, overrides=overrides, quiet=quiet)


def example(
    name: Annotated[
        str | None, typer.Argument(help="Which one to copy; all are listed if not given.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to copy it to.")] = Path(),
) -> None:
    """List the examples, or copy an example with its files, to start from.

    The schema of configuration files is written beside it, for editors that complete and check.
    """
    from runtime.errors import expect_known

    examples = example_files()
    if name is None:
        for each, path in examples.items():
            print(f"{each:18} {_about(path)}")
        return
    expect_known(name, examples, f"expected the name of an example, found {name!r}")
    _copy(examples[name], out, {})


class Language(enum.StrEnum):
    """Languages and ways of an estimator of one's own."""

    PYTHON = "python"
    CPP = "cpp"
    ROS2 = "ros2"


def new_estimator(
    name: Annotated[str, typer.Argument(help="Name of the estimator, and of its files.")],
    language: Annotated[
        Language, typer.Option(help="A node in Python, a C++ program, or a node of ROS 2.")
    ] = Language.PYTHON,
    out: Annotated[Path, typer.Option(help="Folder to write it to.")] = Path(),
) -> None:
    """Begin an estimator of one's own, which flies, tracks and is judged as it is.

    It is the example of that language under another name: an odometry, to be replaced.
    """
    import re

    from runtime.errors import CommandError

    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise CommandError(f"expected a name of small letters, digits and _, found {name!r}")
    called = "".join(word.capitalize() for word in name.split("_"))
    words = {
        Language.PYTHON: {"own_estimator": name, "OwnEstimator": called, '"own"': f'"{name}"'},
        Language.CPP: {
            "outside_cpp": name,
            "odometry.cpp": f"{name}.cpp",
            "FOLDER/odometry": f"FOLDER/{name}",
            "-o odometry": f"-o {name}",
            '"slam"': f'"{name}"',
        },
        Language.ROS2: {"outside_ros2": name},
    }[language]
    words["examples/"] = ""
    copied = _copy(example_files()[next(iter(words))], out, words)
    print(f"try: python -m runtime run {copied}")


def _copy(example: Path, out: Path, words: dict[str, str]) -> Path:
    """Copy an example with all that it reads, words replaced, and the schema; return the copy."""
    import re

    from runtime.errors import CommandError
    from runtime.tools.cli.inspect import schema

    def renamed(text: str) -> str:
        for word, other in words.items():
            text = text.replace(word, other)
        return text

    listed = [example, *_read_by(example)]
    files = [each for file in listed for each in (file, *sorted(file.rglob("*"))) if each.is_file()]
    targets = [out / renamed(str(file.relative_to(example.parent))) for file in files]
    if existing := [target for target in targets if target.exists()]:
        raise CommandError(f"{existing[0]}: expected no file of this name, found one")
    for file, target in zip(files, targets, strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        data = file.read_bytes()
        if words or file.suffix == ".toml":
            text = re.sub(r"\A#:schema .*", f"#:schema {SCHEMA}", renamed(data.decode()))
            data = text.encode()
        target.write_bytes(data)
        print(target)
    schema(out / SCHEMA)  # of the nodes installed now: one from before is replaced
    return targets[0]


def example_files() -> dict[str, Path]:
    """Return the examples by name, or raise `CommandError`; the standard tour is ``config``."""
    from runtime.errors import CommandError

    if INSTALLED.is_dir():
        files = list(INSTALLED.glob("*.toml"))
    else:
        files = [CHECKOUT / "config.toml", *(CHECKOUT / "examples").glob("*.toml")]
    if not files or not all(file.is_file() for file in files):
        raise CommandError(f"expected examples in {INSTALLED}, found none: install the project")
    return {file.stem: file for file in sorted(files)}


def _about(path: Path) -> str:
    comment = []
    for line in path.read_text(encoding="utf-8").splitlines():
        text = line.removeprefix("#").strip()
        if text.startswith(":schema"):
            continue
        if not line.startswith("#") or not text:
            break
        comment.append(text)
    return " ".join(comment).partition(". ")[0].rstrip(".:")


def _read_by(path: Path) -> list[Path]:
    """Return files named in an example: worlds, trajectories, node modules, programs."""
    text = path.read_text(encoding="utf-8")
    beside = (file for file in sorted(path.parent.iterdir()) if file.suffix != ".toml")
    return [
        file
        for file in beside
        if f'"{file.name}"' in text or (file.suffix == ".py" and f'"{file.stem}:' in text)
    ]
