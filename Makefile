# Bare `make` lists the targets.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORE := $(VENV)/.core
READY := $(VENV)/.ready

# Tests start hundreds of processes, which begin sooner if modules stay compiled.
export PYTHONDONTWRITEBYTECODE :=

# Where images are drawn, read, written or tracked.
OPENCV_TESTS := $(addprefix tests/,events sims/cameras sims/scans sims/worlds nodes/calibration nodes/data/dataset \
	nodes/data/replay nodes/estimators nodes/judging/report nodes/mapping nodes/ros2/messages nodes/viewers \
	runtime/tools/monitor)

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-core test-slow test-pythons test-opencv4 test-all check fix size mutants docs wheel mavproxy peers bench bench-quick orbslam3 svo suite images clean

# Setuptools warns at length of every editable install that folders here may hide packages.
INSTALL = PYTHONWARNINGS='ignore:Editable installation' $(BIN)/python -m pip install --quiet

help:  ## List the targets.
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(READY)  ## Make a virtual environment with all that is needed (the others do it too).

$(CORE): pyproject.toml setup.py $(wildcard sims/cameras/rasteriser/*)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "expected Python 3.11 or later, found $$($(PYTHON) --version): set PYTHON="; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(INSTALL) -e .
	@touch $@

# The tests compare with MuJoCo's renderer, through EGL; what it lacks is installed if we may.
$(READY): $(CORE) $(wildcard extensions/*/pyproject.toml) bench/pyproject.toml
	$(INSTALL) -e '.[dev,docs]' $(addprefix -e ,$(wildcard extensions/*/)) -e ./bench
	@sh tools/system_packages.sh gl $(BIN)/python
	@touch $@

demo: $(CORE)  ## Fly the standard tour, judge visual odometry on it, and report in runs/tour/latest.
	$(BIN)/python -m runtime run config.toml

test: $(READY)  ## Run the quick tests.
	@sh tools/system_packages.sh display
	$(BIN)/python -m pytest -n 3 --dist loadfile -m 'not slow'

test-core: $(READY)  ## Run the quick tests of the core, without those of the extensions.
	@sh tools/system_packages.sh display
	$(BIN)/python -m pytest -n 3 --dist loadfile -m 'not slow' tests

# What it needs of its own accord only: with its maps and graphs it is a gigabyte more.
.venv-mavproxy/.ready:
	$(PYTHON) -m venv .venv-mavproxy
	.venv-mavproxy/bin/python -m pip install --quiet 'pymavlink>=2.4.41' pyserial numpy
	.venv-mavproxy/bin/python -m pip install --quiet --no-deps 'MAVProxy>=1.8.70'
	@touch $@

mavproxy: .venv-mavproxy/.ready  ## Install MAVProxy (GPL) in an environment of its own, for its test.

test-slow: $(READY) .venv-mavproxy/.ready  ## Run the slow tests; what fails is repeated once, alone.
	@sh tools/system_packages.sh display
	@sh tools/system_packages.sh arm
	$(BIN)/python -m pytest -n 3 --dist loadfile -m slow || { \
		echo "Repeated once, alone, is what failed above:"; \
		$(BIN)/python -m pytest --last-failed --last-failed-no-failures none -m slow; }

test-pythons: $(READY)  ## Run the core's tests on every other Python that is here.
	@sh tools/test_pythons.sh

# Python looks into the folder first; the oldest version that pyproject.toml allows is in it.
.venv-opencv4: pyproject.toml
	$(BIN)/python -m pip install --quiet --no-deps --upgrade --target $@ 'opencv-python-headless==4.10.*'
	@touch $@

test-opencv4: $(READY) .venv-opencv4  ## Run the quick tests of what draws, sees and writes images with OpenCV 4.
	PYTHONPATH=.venv-opencv4 $(BIN)/python -m pytest -n 3 --dist loadfile -m 'not slow' $(OPENCV_TESTS)

test-all: test test-slow test-pythons test-opencv4  ## Run all tests.

# MODULE=runtime.channels.hold SAMPLE=40 TESTS='tests/further ...' or ONLY='tests/x ...'; see tools/mutants.py.
mutants: $(READY)  ## Plant small faults in a module, MODULE=..., that its quick tests have to notice.
	$(BIN)/python -m tools.mutants $(MODULE) --sample $(or $(SAMPLE),0) --tests $(TESTS) $(if $(ONLY),--only $(ONLY))

check: $(READY)  ## Check style and types.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

fix: $(READY)  ## Mend what style checks can mend.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

size: $(CORE)  ## Print the lines of each room and of the core, what an import brings, files per change.
	@$(BIN)/python tools/size.py

docs: $(READY)  ## Build the documentation into build/site; every broken link is an error.
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

wheel: $(READY)  ## Build the wheel into dist.
	$(BIN)/python -m build --outdir dist .

orbslam3: $(READY)  ## Install ORB-SLAM3 (GPL) and train its vocabulary from rendered images.
	$(INSTALL) -e 'extensions/estimators[orbslam3]'
	@sh tools/system_packages.sh orbslam3 $(BIN)/python
	$(BIN)/python -m runtime vocabulary config.toml

# Without its dependency opencv-python, whose files would replace opencv-python-headless's.
svo: $(READY)  ## Install SVO (GPL).
	$(BIN)/python -m pip install --quiet --no-deps 'svo-cpp>=1.5'
	$(BIN)/python -c 'import svo_cpp, cv2'

suite: $(READY)  ## Judge all estimators that are installed in all scenarios; writes bench/SUITE.md.
	$(BIN)/python -m runtime suite --page bench/SUITE.md

peers: $(READY)  ## Install what the benchmarks compare with (PyPI, and Debian's ROS 1 and C++).
	$(INSTALL) -e './bench[peers]'
	@sh tools/system_packages.sh peers

bench: $(READY)  ## Run every benchmark and write bench/results/RESULTS.md (about 20 minutes).
	$(BIN)/python -m runtime bench all --out bench/results --page bench/RESULTS.md

bench-quick: $(READY)  ## Run the quick benchmarks (under two minutes).
	$(BIN)/python -m runtime bench all --quick --out runs/bench-quick

images: demo $(READY)  ## Make the documentation's images (needs ORB-SLAM3, evalio and Chromium; minutes).
	$(BIN)/python -m runtime suite --scenario office --repeat 1 --out runs/office \
		--estimator features --estimator orb_slam3_rgbd --estimator kiss_icp
	$(BIN)/python tools/readme_images.py
	$(BIN)/python tools/gallery.py
	$(BIN)/python -m runtime run extensions/rerun/examples/rerun.toml
	$(BIN)/python tools/viewer_image.py runs/rerun/latest/flight.rrd docs/images/rerun.png
	$(BIN)/python tools/monitor_images.py

clean:  ## Remove the environment, results and caches.
	rm -rf $(VENV) .venv-mavproxy runs sweeps .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
