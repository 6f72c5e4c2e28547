# Everything runs from a virtual environment in the checkout (.venv), which the first target makes with the packages that
# constraints.txt pins; only 'demo', 'test' and 'bench' also need a GL library, and install one where they can.
#
#   make demo PYTHON=python3.12          another Python, 3.11 or 3.12 (the first time, or after 'make clean-venv')
#   make test PYTEST_ARGS="-k replay"    further arguments for pytest, DEMO_ARGS and BENCH_ARGS likewise
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
#                                        the first time, on a machine without an NVIDIA GPU: on Linux, the torch that
#                                        PyPI offers brings several GB of CUDA packages

PYTHON ?= python3
TORCH_INDEX ?=
DEMO_ARGS ?=
PYTEST_ARGS ?=
PYTEST_WORKERS ?= 2
BENCH_ARGS ?=
# Golden files of the official implementation.
GOLDEN ?= tests/golden/*.npz

VENV := .venv
BIN := $(VENV)/bin
SOURCES := $(wildcard sb3_dreamer_urlb tests benchmarks scripts examples custom_envs.py)
export PYTHON TORCH_INDEX VENV

# Workers share the cores: one thread each, for torch and for the software renderer.
ONE_THREAD := OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} LP_NUM_THREADS=$${LP_NUM_THREADS:-0}

.DEFAULT_GOAL := help
.PHONY: help setup setup-gl demo test test-slow faults format lint type docs notebook bench golden constraints clean clean-venv

help:  ## list the targets
	@echo "make TARGET, where TARGET is one of"
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

demo: setup-gl  ## set up, then run the demonstration (DEMO_ARGS)
	$(BIN)/sb3-dreamer-urlb demo $(DEMO_ARGS)

test: setup-gl  ## set up, then run the tests but the slow ones (PYTEST_ARGS, PYTEST_WORKERS)
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(PYTEST_WORKERS) $(PYTEST_ARGS)

test-slow: setup-gl  ## run the long learning checks, one after the other (PYTEST_ARGS)
	$(BIN)/python -m pytest -m slow --timeout=0 $(PYTEST_ARGS)

faults: setup-gl  ## inject faults for some minutes: kills, damaged files, dying workers; ends with a table (PYTEST_ARGS)
	$(ONE_THREAD) $(BIN)/python tests/helpers/faults.py $(PYTEST_ARGS)

format: setup  ## sort imports and format the code
	$(BIN)/ruff check --select I --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

lint: setup  ## find faults, imports that point upwards (.importlinter), and code that 'make format' would change
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/lint-imports --no-logo

type: setup  ## check the types
	$(BIN)/mypy

# Not --quiet: it would hide the warnings from --strict. The variable silences an advertisement of the theme's maker.
docs: setup  ## build the documentation into site/; any warning fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

notebook: setup-gl  ## run examples/quickstart.ipynb and store it with its outputs
	$(BIN)/python scripts/run_notebook.py

bench: setup-gl  ## measure speed and memory on a CPU, ratios first, in under ten minutes (BENCH_ARGS)
	$(BIN)/python benchmarks/update.py --repeat 1 $(BENCH_ARGS)
	$(BIN)/python benchmarks/planner.py --repeat 2 $(BENCH_ARGS)
	$(BIN)/python benchmarks/replay.py $(BENCH_ARGS)
	$(BIN)/python benchmarks/snapshot.py $(BENCH_ARGS)
	$(BIN)/python benchmarks/collect.py --domains walker --environments 1 2 4 --repeat 2 $(BENCH_ARGS)
	$(BIN)/python benchmarks/end_to_end.py --repeat 1 $(BENCH_ARGS)

golden: setup  ## compare with the official implementation's numbers (GOLDEN: files)
	$(BIN)/python tests/helpers/golden.py $(GOLDEN)

constraints:  ## make constraints.txt anew from setup.cfg's ranges
	scripts/constraints.sh

setup:  ## only make the virtual environment
	@scripts/setup.sh

setup-gl:  ## only make the virtual environment, and see to a GL library
	@scripts/setup.sh gl

clean:  ## remove caches and build output
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis demo_output demo_pixels_output site
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -exec rm -rf {} +

clean-venv: clean  ## remove the virtual environment, too
	rm -rf $(VENV)
