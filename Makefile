# make demo   train, score and film the lunar-lander recipe, and compare it with a flat agent
# make test   the tests            make check   ruff, mypy, import order, tests
# make bench  the benchmarks       make weights the shipped weights, made anew
# make docs   the documentation, as a site in site/
# make torture  mutated files, kills, bad disks, hostile code: an hour
PYTHON ?= python3
# One torch for everything, installed first: a plain `torch` may pull gigabytes of CUDA.
TORCH ?= torch==2.13.0
BIN := .venv/bin
SEED ?= 0
# Recipes whose weights are shipped (those of keys-and-doors would be 10 MB), as two cores make them: on
# as many, pick-and-place's are the same, as one process for each core steps its environments.
WITH_WEIGHTS := lunar-lander lunar-lander-tuned lander-missions mazes shuttle pick-and-place
# One process for each core, and one more, as some tests wait for other processes; a process that
# has no tests left takes some of another's.
CORES := $(BIN)/python -c 'import os; a = getattr(os, "sched_getaffinity", None); print(len(a(0)) if a else os.cpu_count())'
# Compiled modules are kept even where the shell says that they are not to be: tests start many
# processes that import the same ones.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $$(($$($(CORES)) + 1)) --dist worksteal

.PHONY: demo test check docs torture bench figures weights smoke clean

.venv/demo: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Skillweave needs Python 3.11 or newer, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[demo]"
	touch $@

.venv/dev: .venv/demo
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	touch $@

demo: .venv/demo
	$(BIN)/skillweave train lunar-lander --seed $(SEED) --render --versus-flat

smoke: .venv/demo
	$(BIN)/skillweave train lunar-lander --seed $(SEED) --render --versus-flat --scale 0.02 --evaluate 5

test: .venv/dev
	$(PYTEST)

check: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(PYTEST)

docs: .venv/demo
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

torture: .venv/dev
	$(BIN)/python -m scripts.torture --seed $(SEED)

bench: .venv/dev
	$(BIN)/python -m benchmarks

figures: .venv/dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[bench]"
	$(BIN)/python -m benchmarks --all

weights: .venv/demo
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[robotics]"
	$(foreach r,$(WITH_WEIGHTS),rm -rf runs/weights-$(r) && \
	$(BIN)/skillweave train $(r) --seed 0 --out runs/weights-$(r) && \
	$(BIN)/skillweave weights runs/weights-$(r) --out skillweave/recipes/$(subst -,_,$(r)).safetensors &&) true

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache
