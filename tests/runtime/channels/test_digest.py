"""The digest: equal for equal events, and different for any other."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from events import Event
from runtime import Duration, Node, Output
from runtime.channels.wire import Digest
from runtime.config.model import Config, RunConfig
from runtime.errors import ChannelTypeError, NodeError
from runtime.run.execute import execute
from runtime.testing import spec
from tests.runtime.small_events import Said, Shouted, said

DTYPES = ["uint8", "int32", ">i4", "float32", "float64", "bool"]


class Measured(Event, eq=False):
    """Holds an array of any kind, and whatever else."""

    data: npt.NDArray[Any]
    extra: Any = None


texts = st.text(max_size=5)
stamps = st.integers(0, 2**63 - 1)
sayings = st.builds(Said, stamp=stamps, source=texts, text=texts) | st.builds(
    Shouted, stamp=stamps, source=texts, text=texts
)
arrays = st.sampled_from(DTYPES).flatmap(
    lambda dtype: hnp.arrays(
        dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
    )
)


def digest(*events: Event) -> str:
    taking = Digest()
    for event in events:
        taking(None, event)
    return taking.hexdigest()


def measured(data: npt.NDArray[Any], extra: Any = None) -> Measured:
    return Measured(stamp=0, source="vague", data=data, extra=extra)


def by_speaker(events: Iterable[Said]) -> dict[str, list[tuple[type, Said]]]:
    """Return what each node said, in order; what a digest is made of."""
    said_by: dict[str, list[tuple[type, Said]]] = {}
    for event in events:
        said_by.setdefault(event.source.partition("/")[0], []).append((type(event), event))
    return said_by


@given(st.lists(sayings, max_size=4), st.lists(sayings, max_size=4))
def test_digests_are_equal_exactly_if_what_each_said_is(one: list[Said], other: list[Said]) -> None:
    assert (digest(*one) == digest(*other)) == (by_speaker(one) == by_speaker(other))


@pytest.mark.slow
@given(st.lists(sayings, max_size=6).flatmap(lambda e: st.tuples(st.just(e), st.permutations(e))))
def test_the_order_counts_within_a_speaker_only(pair: tuple[list[Said], list[Said]]) -> None:
    one, other = pair
    assert (digest(*one) == digest(*other)) == (by_speaker(one) == by_speaker(other))


@pytest.mark.slow
@given(arrays, arrays)
def test_arrays_are_told_apart_by_type_shape_and_content(
    one: npt.NDArray[Any], other: npt.NDArray[Any]
) -> None:
    same = (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    assert (digest(measured(one)) == digest(measured(other))) == same


@given(st.sampled_from(DTYPES), st.data())
def test_one_other_bit_is_noticed(dtype: str, data: st.DataObject) -> None:
    array = np.zeros(data.draw(st.integers(1, 1000)), dtype)
    changed = array.copy()
    changed[data.draw(st.integers(0, len(array) - 1))] = 1
    assert digest(measured(array)) != digest(measured(changed))


def test_types_and_shapes_of_the_same_bytes_are_told_apart() -> None:
    data = np.zeros(8, np.uint8)
    views: list[npt.NDArray[Any]] = [
        data,
        data.view(np.int32),
        data.view(np.float32),
        data.reshape(2, 4),
        data.view(">i4"),
    ]
    assert len({digest(measured(view)) for view in views}) == len(views)


@pytest.mark.slow
@given(hnp.arrays("float32", hnp.array_shapes(min_dims=2, max_dims=3)))
def test_the_layout_in_memory_does_not_matter(array: npt.NDArray[np.float32]) -> None:
    assume(not np.isnan(array).any())
    strided = np.repeat(array, 2, axis=-1)[..., ::2]
    copies: list[npt.NDArray[Any]] = [np.asfortranarray(array), strided]
    for same in copies:
        assert digest(measured(same)) == digest(measured(array))


@given(st.permutations(["a", "b", "c", "d"]))
def test_the_order_within_sets_and_mappings_does_not_matter(names: list[str]) -> None:
    array = np.zeros(1)
    mapping = {name: ord(name) for name in names}
    assert digest(measured(array, mapping)) == digest(
        measured(array, dict(sorted(mapping.items())))
    )
    assert digest(measured(array, set(names))) == digest(measured(array, set("abcd")))


@pytest.mark.slow
def test_another_process_finds_the_same() -> None:
    """Hashes of texts, and so the order of sets, differ from process to process."""
    code = """
import numpy as np
from tests.runtime.channels.test_digest import digest, measured, said
print(digest(said("x"), measured(np.arange(5), {"a", "b", "c", "d", "e"})))
"""
    digests = {
        subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    }
    assert digests == {digest(said("x"), measured(np.arange(5), set("abcde"))) + "\n"}


def test_many_small_events_and_one_large_are_taken_in_alike() -> None:
    """However much has come together between two looks at the digest."""
    events = [said(str(i) * 50) for i in range(3000)]
    looked_at, not_looked_at = Digest(), Digest()
    for event in events:
        looked_at(None, event)
        not_looked_at(None, event)
        looked_at.hexdigest()
    assert looked_at.hexdigest() == not_looked_at.hexdigest() == digest(*events)


def test_an_event_has_its_place() -> None:
    assert digest(said("a"), said("b")) != digest(said("b"), said("a"))


def test_the_digest_has_32_hexadecimal_digits() -> None:
    assert len(bytes.fromhex(digest())) == 16


class Opaque:
    """An object of which nobody knows what is in it."""


@pytest.mark.parametrize(
    "extra",
    [
        Opaque(),
        [1, Opaque()],
        {"a": Opaque()},
        np.array([Opaque()], object),
        Fraction(1, 2),
        1 << 80,
        np.longdouble(1),
    ],
    ids=["object", "list", "mapping", "array", "fraction", "integer", "longdouble"],
)
def test_what_is_no_data_has_no_digest(extra: Any) -> None:
    taken = Digest()
    with pytest.raises(ChannelTypeError, match=r"expected Measured to hold data.*digest = false"):
        taken(None, measured(np.zeros(1), extra))


@pytest.mark.slow
def test_a_node_that_sends_what_is_no_data_is_told_so(tmp_path: Path) -> None:
    class Vague(Node):
        out_ = Output(Measured)

        async def run(self) -> None:
            self.out_.send(measured(np.zeros(1), Opaque()))

    node = spec(Vague, "vague")
    with pytest.raises(NodeError, match=r"^vague: vague\.out_: expected Measured to hold data"):
        execute(Config(run=RunConfig(duration=Duration(1)), nodes=(node,)), tmp_path)
    free = Config(run=RunConfig(duration=Duration(1), digest=False), nodes=(node,))
    assert execute(free, tmp_path).digest is None
