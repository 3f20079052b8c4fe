"""A vocabulary is a full tree of the words that its descriptors fall into."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from nodes.estimators.orb_slam3.vocabulary import Bytes, TreeShape, Vocabulary, train

SMALL = TreeShape(branching=4, depth=3)


def bits_between(a: Bytes, b: Bytes) -> int:
    return int(np.unpackbits(a ^ b).sum())


def clusters(count: int, of: int, flips: int, seed: int = 0) -> tuple[Bytes, Bytes]:
    """Return random centres, and descriptors of each that differ from it in a few bits."""
    rng = np.random.default_rng(seed)
    centres = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    bits = np.repeat(np.unpackbits(centres, axis=1), of, axis=0)
    for row in bits:
        row[rng.choice(256, flips, replace=False)] ^= 1
    return centres, np.packbits(bits, axis=1)


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
    found = tree.descriptors[1:]
    assert {row.tobytes() for row in found} == {row.tobytes() for row in centres}
    words = tree.words(descriptors).reshape(4, 60)
    assert (words == words[:, :1]).all()
    assert len(set(words[:, 0])) == 4


def test_a_descriptor_s_word_is_the_nearest_child_at_each_level() -> None:
    tree = trained()
    rng = np.random.default_rng(2)
    queries = rng.integers(0, 256, (50, 32), dtype=np.uint8)
    for query, word in zip(queries, tree.words(queries), strict=True):
        node = 0
        while not tree.leaves[node]:
            below = np.flatnonzero(tree.parents == node)
            node = below[np.argmin([bits_between(query, tree.descriptors[b]) for b in below])]
        assert node == word


def test_the_nearest_word_of_a_trained_descriptor_is_near() -> None:
    tree = trained()
    descriptors = np.concatenate(random_images())
    words = tree.words(descriptors)
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
    weights = tree.weights[tree.words(centres)]
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
