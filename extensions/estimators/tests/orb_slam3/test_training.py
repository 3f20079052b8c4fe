"""A vocabulary comes of a run's images: by the node, and by the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from events import Event, Image
from extensions.estimators.tests.orb_slam3.scene import views
from extensions.estimators.tests.orb_slam3.test_vocabulary import read_vocabulary
from runtime.errors import ConfigError, NodeError
from runtime.testing import run_node
from visnav_estimators.orb_slam3.training import VocabularyTrainer, describe, vocabulary

SHAPE = {"branching": 5, "depth": 2, "index_level": 0}
CONFIG = """
[run]
duration = "1s"

[[nodes]]
name = "camera"
type = "extensions.estimators.tests.orb_slam3.scene:Still"

[[nodes]]
name = "slam"
type = "OrbSlam3"
"""


def image(stamp: int, source: str = "drone/front", grey: bool = False) -> Image:
    rgb = views(1)[0].rgb
    data = np.ascontiguousarray(rgb[:, :, 1]) if grey else rgb
    encoding = "mono8" if grey else "rgb8"
    return Image(stamp=stamp, source=source, frame_id="f", encoding=encoding, data=data)


def train(path: Path, inputs: list[Event], **config: object) -> None:
    config = {"path": str(path), "shape": SHAPE, "image_interval": 2, **config}
    run_node(VocabularyTrainer, inputs=inputs, config=config)


def test_some_images_of_each_camera_make_a_vocabulary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    described: list[tuple[int, ...]] = []

    def noting(data: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], features: int) -> object:
        described.append(data.shape)
        return describe(data, features)

    monkeypatch.setattr("visnav_estimators.orb_slam3.training.describe", noting)
    colour = [image(k * 10_000_000) for k in range(5)]
    grey = [image(k * 10_000_000 + 1, "drone/down", grey=True) for k in range(2)]
    path = tmp_path / "vocabulary.txt"
    train(path, sorted([*colour, *grey], key=lambda i: i.stamp))
    tree = read_vocabulary(path)
    assert sorted(described) == [(240, 320), *[(240, 320, 3)] * 3]
    assert (tree.branching, tree.depth, tree.leaves.sum()) == (5, 4, 25)


def test_the_same_images_make_the_same_file(tmp_path: Path) -> None:
    first, second = tmp_path / "first.txt", tmp_path / "second.txt"
    train(first, [image(0)])
    train(second, [image(0)])
    assert first.read_bytes() == second.read_bytes()


def test_an_image_without_corners_has_no_descriptors() -> None:
    assert describe(np.full((60, 80, 3), 90, np.uint8), 100).shape == (0, 32)


def test_no_images_make_an_error_and_no_file(tmp_path: Path) -> None:
    with pytest.raises(NodeError, match="found 0 in 0 images"):
        train(tmp_path / "vocabulary.txt", [])
    assert not list(tmp_path.iterdir())


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "config.toml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


def test_the_command_leaves_orb_slam3_out_and_puts_the_file_where_it_looks(
    tmp_path: Path, config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        vocabulary(config, quiet=True)
    [path] = (tmp_path / "cache" / "visnav-runtime").iterdir()
    assert read_vocabulary(path).leaves.sum() > 100
    assert str(path) in capsys.readouterr().out
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_the_command_writes_where_it_is_told(
    tmp_path: Path, config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        vocabulary(config, out=Path("own.txt"), quiet=True)
    assert read_vocabulary(tmp_path / "own.txt").leaves.any()
    assert f'vocabulary = "{tmp_path / "own.txt"}"' in capsys.readouterr().out


def test_the_command_refuses_a_name_that_orb_slam3_would_read_as_binary(
    tmp_path: Path, config: Path
) -> None:
    with pytest.raises(ConfigError, match=r"--out: expected a name that ends with \.txt"):
        vocabulary(config, out=tmp_path / "own.voc", quiet=True)
