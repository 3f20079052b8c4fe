"""A vocabulary is a full tree of the words that its descriptors fall into, and DBoW2's file."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from visnav_estimators.orb_slam3.settings import (
    Bytes,
    TreeShape,
    Vocabulary,
    cached_vocabulary,
    check_vocabulary,
    find_vocabulary,
    train,
    write_vocabulary,
)

SMALL = TreeShape(branching=4, depth=3)


def bits_between(a: Bytes, b: Bytes) -> int:
    return int(np.unpackbits(a ^ b).sum())


def words_of(tree: Vocabulary, descriptors: Bytes) -> list[int]:
    """Return the word of each descriptor: from the root down, to the nearest child each time."""
    words = []
    for descriptor in descriptors:
        node = 0
        while not tree.leaves[node]:
            below = np.flatnonzero(tree.parents == node)
            node = below[np.argmin([bits_between(descriptor, tree.descriptors[b]) for b in below])]
        words.append(node)
    return words


def clusters(count: int, of: int, flips: int, seed: int = 0) -> tuple[Bytes, Bytes]:
    """Return random centres, and descriptors of each that differ from it in a few bits."""
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    bits = np.repeat(np.unpackbits(centres, axis=1), of, axis=0)
    for row in bits:
        row[rng.choice(256, flips, replace=False)] ^= 1
    return centres, np.packbits(bits, axis=1)


def read_vocabulary(path: Path) -> Vocabulary:
    branching, depth = check_vocabulary(path)
    rows = np.loadtxt(path, skiprows=1, ndmin=2)
    table = np.vstack([[-1, 0, *[0] * 32, 0], rows])
    return Vocabulary(
        branching=branching,
        depth=depth,
        parents=table[:, 0].astype(np.int64),
        leaves=table[:, 1].astype(bool),
        descriptors=table[:, 2:-1].astype(np.uint8),
        weights=table[:, -1].copy(),
    )


@cache
def random_images() -> tuple[Bytes, ...]:
    rng = np.random.default_rng(1)
    return tuple(rng.integers(0, 256, (400, 32), dtype=np.uint8) for _ in range(10))


@cache
def trained() -> Vocabulary:
    return train(random_images(), SMALL)


def test_the_tree_is_complete_where_there_are_descriptors_enough() -> None:
    tree = trained()
    assert len(tree.parents) == 1 + 4 + 16 + 64
    assert tree.leaves.sum() == 64
    children = np.bincount(tree.parents[1:], minlength=len(tree.parents))
    assert set(children[~tree.leaves]) == {4}
    assert set(children[tree.leaves]) == {0}
    assert (tree.parents[1:] < np.arange(1, len(tree.parents))).all()


def test_clusters_are_found_and_a_centre_has_the_bits_that_most_members_have() -> None:
    centres, descriptors = clusters(4, of=60, flips=8)
    tree = train([descriptors], TreeShape(branching=4, depth=1))
    learned = tree.descriptors[1:]
    assert {row.tobytes() for row in learned} == {row.tobytes() for row in centres}
    words = np.reshape(words_of(tree, descriptors), (4, 60))
    assert (words == words[:, :1]).all()
    assert len(set(words[:, 0])) == 4


def test_the_nearest_word_of_a_trained_descriptor_is_near() -> None:
    tree = trained()
    descriptors = np.concatenate(random_images())[::10]
    words = words_of(tree, descriptors)
    near = np.mean(
        [bits_between(*p) for p in zip(descriptors, tree.descriptors[words], strict=True)]
    )
    far = np.mean([bits_between(d, tree.descriptors[words[0]]) for d in descriptors])
    assert near < 110 < 126 < far  # random ones differ in half of 256 bits


def test_the_same_input_gives_the_same_tree_and_another_seed_another() -> None:
    again = train(random_images(), SMALL)
    assert again.descriptors.tobytes() == trained().descriptors.tobytes()
    assert again.weights.tobytes() == trained().weights.tobytes()
    other = train(random_images(), TreeShape(branching=4, depth=3, seed=1))
    assert other.descriptors.tobytes() != trained().descriptors.tobytes()


def test_rare_words_weigh_more_and_common_ones_something() -> None:
    centres, descriptors = clusters(2, of=30, flips=4)
    common, rare = descriptors[:30], descriptors[30:]
    images = [common[:10], common[10:20], np.concatenate([common[20:], rare])]
    tree = train(images, TreeShape(branching=2, depth=1))
    weights = tree.weights[words_of(tree, centres)]
    assert weights == pytest.approx([np.log(4 / 3), np.log(4 / 1)])
    assert tree.weights[0] == 0


def test_what_cannot_be_split_is_a_word() -> None:
    _, descriptors = clusters(3, of=1, flips=0)
    tree = train([np.repeat(descriptors, 20, axis=0)], TreeShape(branching=10, depth=4))
    assert tree.parents.tolist() == [-1, 0, 0, 0]
    assert tree.leaves.tolist() == [False, True, True, True]


@pytest.mark.parametrize(("depth", "index_level", "expected"), [(4, 0, 4), (4, 2, 6), (6, 1, 6)])
def test_the_file_s_depth_puts_the_index_where_it_is_wanted(
    depth: int, index_level: int, expected: int
) -> None:
    shape = TreeShape(depth=depth, index_level=index_level)
    assert shape.header_depth() == expected


def test_too_few_or_wrong_descriptors_are_refused() -> None:
    with pytest.raises(ValueError, match=r"at least 10 descriptors.*found 5 in 2 images"):
        train([np.zeros((5, 32), np.uint8), np.zeros((0, 32), np.uint8)])
    with pytest.raises(ValueError, match=r"shape \(n, 32\), found uint8 of shape \(20, 16\)"):
        train([np.zeros((20, 16), np.uint8)])
    with pytest.raises(ValueError, match="found float32"):
        train([np.zeros((20, 32), np.float32)])


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
