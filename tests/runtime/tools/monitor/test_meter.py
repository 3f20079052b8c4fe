"""What a node had of the loop, when nodes call each other."""

from __future__ import annotations

import types
from typing import Any

import pytest

from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.tools.monitor import snapshot as meter
from runtime.tools.monitor.snapshot import Amount


def test_a_step_counts_without_those_within_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0]

    def work(ns: int) -> None:
        now[0] += ns

    monkeypatch.setattr(meter, "time", types.SimpleNamespace(perf_counter_ns=lambda: now[0]))
    loop = LockstepLoop()
    try:
        found = meter.Meter(LockstepClock(loop))

        def fail(_: Any) -> None:
            work(5)
            raise RuntimeError

        inner = found.wrap_call("b", "hear", work)
        failing = found.wrap_call("c", "hear", fail)

        def outer(_: Any) -> None:
            work(10)
            inner(100)
            inner(200)
            with pytest.raises(RuntimeError):
                failing(None)
            work(20)

        found.wrap_call("a", "tick", outer)(None)
        found.wrap_call("a", "tick", work)(7)
    finally:
        loop.close()
    assert found.nodes["a"].take() == Amount(2, 37, 30)
    assert found.nodes["b"].take() == Amount(2, 300, 200)
    assert found.nodes["c"].take() == Amount(1, 5, 5)
    assert found.nodes["a"].take() == Amount()
