"""Vocabularies are written in DBoW2's text format, and files that are none are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nodes.estimators.orb_slam3.vocabulary import (
    TreeShape,
    cached_vocabulary,
    check_vocabulary,
    find_vocabulary,
    train,
    write_vocabulary,
)
from tests.nodes.estimators.orb_slam3.reading import read_vocabulary
from tests.nodes.estimators.orb_slam3.test_vocabulary import trained

NODE = "0 1 " + "7 " * 32 + "0.5"


def written(folder: Path, *lines: str, name: str = "vocabulary.txt") -> Path:
    path = folder / name
    path.write_text("\n".join(lines), encoding="ascii")
    return path


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "not" / "there" / "yet.txt"
    write_vocabulary(trained(), path)
    again = read_vocabulary(path)
    assert (again.branching, again.depth) == (4, 5)
    for field in ("parents", "leaves", "descriptors"):
        np.testing.assert_array_equal(getattr(again, field), getattr(trained(), field))
    np.testing.assert_allclose(again.weights, trained().weights, rtol=1e-8)
    assert [p.name for p in path.parent.iterdir()] == ["yet.txt"]


def test_the_format_is_dbow2s(tmp_path: Path) -> None:
    descriptors = np.repeat([[0], [255]], 32, axis=1).astype(np.uint8)
    shape = TreeShape(branching=2, depth=1, index_level=0)
    tree = train([descriptors[:1], descriptors[1:]], shape)
    path = tmp_path / "vocabulary.txt"
    write_vocabulary(tree, path)
    header, *nodes = path.read_text(encoding="ascii").split("\n")
    assert header == "2 4 0 0"
    half = f"{np.log(3):.9g}"  # in one of two images: ln (2 + 1) / 1
    expected = {f"0 1 {' '.join([b] * 32)} {half}" for b in ("0", "255")}
    assert set(nodes) == expected
    assert len(nodes) == 2  # no empty line at the end, which DBoW2 would take for a node


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["10 4 0", NODE], r"line 1: expected four whole numbers .*found '10 4 0'"),
        (["%YAML:1.0", NODE], r"line 1: expected four whole numbers .*found '%YAML:1.0'"),
        (["10 40 0 0", NODE], r"line 1: expected branching 2 to 20, depth 1 to 10.*'10 40 0 0'"),
        (["10 4 0 0"], r"line 2: expected 35 numbers .*found ''"),
        (["10 4 0 0", "0 1 2 3"], r"line 2: expected 35 numbers .*found '0 1 2 3'"),
        (["10 4 0 0", NODE.replace("7", "x")], r"line 2: expected 35 numbers"),
    ],
)
def test_what_is_no_vocabulary_is_refused_where_it_is_wrong(
    tmp_path: Path, lines: list[str], message: str
) -> None:
    path = written(tmp_path, *lines)
    with pytest.raises(ValueError, match=message) as caught:
        check_vocabulary(path)
    assert str(caught.value).startswith(str(path))


def test_files_that_are_missing_or_binary_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.txt: expected a vocabulary file, found: No such"):
        check_vocabulary(tmp_path / "none.txt")
    binary = tmp_path / "vocabulary.txt"
    binary.write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match="found a binary file"):
        check_vocabulary(binary)
    misnamed = written(tmp_path, "10 4 0 0", NODE, name="vocabulary.bin")
    with pytest.raises(ValueError, match=r"expected a name that ends with \.txt"):
        check_vocabulary(misnamed)


def test_the_cache_is_where_the_user_s_caches_are_and_tells_shapes_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = TreeShape()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cached_vocabulary(shape).parent == tmp_path / "visnav-runtime"
    assert cached_vocabulary(shape) == cached_vocabulary(TreeShape())
    assert cached_vocabulary(shape) != cached_vocabulary(TreeShape(depth=5))
    assert cached_vocabulary(shape, tmp_path / "here").parent.parent == tmp_path / "here"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/someone")
    assert cached_vocabulary(shape).parent == Path("/home/someone/.cache/visnav-runtime")


def test_a_setting_names_a_file_or_the_cached_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ValueError, match=r"python -m runtime vocabulary config\.toml"):
        find_vocabulary("")
    cached = cached_vocabulary(TreeShape())
    write_vocabulary(trained(), cached)
    assert find_vocabulary("") == cached
    own = written(tmp_path, "10 4 0 0", NODE)
    assert find_vocabulary(str(own)) == own
    with pytest.raises(ValueError, match=r"none\.txt, found none.*python -m runtime vocabulary"):
        find_vocabulary(str(tmp_path / "none.txt"))
