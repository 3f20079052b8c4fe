"""The part of the build that pyproject.toml cannot describe: the compiled rasteriser."""

import platform
from pathlib import Path

from setuptools import Extension, setup

# The same bytes everywhere: no contraction, no reordering. It is called by ctypes, not imported.
FLAGS = [
    "-std=c++17",
    "-O3",
    "-pthread",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
]
FLAGS += ["-fvisibility=hidden", "-Wno-psabi"]
FOLDER = Path("sims/cameras/rasteriser")
MACHINES = {"x86_64": {"avx2": ["-mavx2"], "sse4": ["-msse4.1"]}}
"""Names of instruction sets by machine, the quickest first; another machine has one for all."""

setup(
    ext_modules=[
        Extension(
            f"sims.cameras._raster_{name}",
            [str(path) for path in FOLDER.glob("*.cpp")],
            depends=[str(path) for path in FOLDER.glob("*.hpp")],
            extra_compile_args=[*FLAGS, *flags],
            optional=True,  # MuJoCo's renderer needs none
        )
        for name, flags in MACHINES.get(platform.machine(), {"any": []}).items()
    ]
)
