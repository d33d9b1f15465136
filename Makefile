# make demo     train, score and film two tasks: where skills pay, and where not (3 minutes)
# make test     the fast tests                 make test-all  all tests
# make test-versions  a share of the tests with the lowest and the newest versions of what it needs
# make check    ruff, mypy, the fast tests     make docs      the documentation, as a site in site/
# make bench    the benchmarks                 make weights   train the shipped weights again
# make torture  damaged files, kills, full disks, hostile code: an hour
PYTHON ?= python3
# Torch is installed first, from its CPU index where that can be reached: PyPI's torch brings gigabytes of
# CUDA on Linux. With a GPU: make demo TORCH_INDEX=
TORCH ?= torch==2.13.0
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
BIN := .venv/bin
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
SEED ?= 0
# Recipes whose weights are shipped (those of keys-and-doors would be 10 MB), as two cores make them: on
# as many, pick-and-place's are the same, as one process for each core steps its environments.
WITH_WEIGHTS := lunar-lander lander-missions mazes shuttle pick-and-place
# One process for each core, and one more, as some tests wait for other processes; a process that
# has no tests left takes some of another's.
CORES := $(BIN)/python -c 'import os; a = getattr(os, "sched_getaffinity", None); print(len(a(0)) if a else os.cpu_count())'
# Compiled modules are kept even where the shell says that they are not to be: tests start many
# processes that import the same ones.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $$(($$($(CORES)) + 1)) --dist worksteal

.PHONY: demo test test-slow test-all test-versions check docs torture bench figures weights smoke clean

.venv/demo: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Skillweave needs Python 3.11 or newer, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(PIP) --retries 2 $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) "$(TORCH)"
	$(PIP) -e ".[demo]"
	touch $@

.venv/dev: .venv/demo
	$(PIP) -e ".[dev]"
	touch $@

demo: .venv/demo
	rm -rf runs/demo
	$(BIN)/skillweave demo --seed $(SEED)

smoke: .venv/demo
	rm -rf runs/smoke
	$(BIN)/skillweave demo --seed $(SEED) --scale 0.02 --out runs/smoke

test: .venv/dev
	$(PYTEST) -m "not slow"

test-slow: .venv/dev
	$(PYTEST) -m slow

test-all: .venv/dev
	$(PYTEST)

test-versions: .venv/dev
	$(BIN)/python -m scripts.versions

check: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(PYTEST) -m "not slow"

docs: .venv/demo
	$(PIP) -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

torture: .venv/dev
	$(BIN)/python -m scripts.torture --seed $(SEED)

bench: .venv/dev
	$(BIN)/python -m benchmarks

figures: .venv/dev
	$(PIP) -e ".[bench]"
	$(BIN)/python -m benchmarks --all

weights: .venv/demo
	$(PIP) -e ".[robotics]"
	$(foreach r,$(WITH_WEIGHTS),rm -rf runs/weights-$(r) && \
	$(BIN)/skillweave train $(r) --seed 0 --out runs/weights-$(r) && \
	$(BIN)/skillweave weights runs/weights-$(r) --out skillweave/recipes/$(subst -,_,$(r)).safetensors &&) true

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache
