"""What holds for all tests, which run beside each other: one thread a library, no deadlines.

Threads of OpenBLAS and OpenCV that wait for work keep a core busy, which another test needs.
"""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Generator
from functools import cache

import pytest
from hypothesis import settings

# Whoever runs the tests under nohup does not mean the runs that they start and interrupt.
for number in (signal.SIGHUP, signal.SIGINT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")


def pytest_configure(config: pytest.Config) -> None:
    """Have pytest-xdist run files in their order, of which the last ones are short.

    By itself it runs those with few tests last: a report, a study, shadow maps. One of them keeps a
    worker busy for seconds while the other has nothing left.
    """
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Exclude the tests themselves, a million objects, from garbage collection."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_collection_finish() -> None:
    """Ask git once for the commit that the summary of each run has: two processes a run otherwise.

    The tests of the commit itself, which have imported the function by now, ask each time.
    """
    from runtime import commit  # after the environment above

    pytest.MonkeyPatch().setattr(commit, "of_repository", cache(commit.of_repository))


# Objects are made and dropped by the million: the usual 700 between collections are too few.
gc.set_threshold(20_000, 20, 10)

# A deadline is real time, of which a busy machine may take any amount.
settings.register_profile("without deadlines", deadline=None, max_examples=50)
settings.register_profile("thorough", deadline=None, max_examples=2000)  # --hypothesis-profile=…
# Where a change is judged, the same examples each time: new ones are found at the desk.
settings.register_profile("judging", deadline=None, derandomize=True)  # 100 examples
settings.load_profile("judging" if os.environ.get("CI") else "without deadlines")
