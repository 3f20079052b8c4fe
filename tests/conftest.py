"""What holds for all tests, which run beside each other: one thread a library, no deadlines.

Threads of OpenBLAS and OpenCV that wait for work keep a core busy, which another test needs.
"""

from __future__ import annotations

import os

from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

# A deadline is real time, of which a busy machine may take any amount.
settings.register_profile("without deadlines", deadline=None)
settings.register_profile("thorough", deadline=None, max_examples=2000)  # --hypothesis-profile=…
settings.load_profile("without deadlines")
