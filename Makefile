# make is the contract: every target sets up what it needs in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.offbench-installed

.PHONY: demo test nightly lint bench docs clean mujoco-versions

# One install serves all targets; it is repeated when the requirements change.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt torch
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev]"
	@touch $@

# A small halfcheetah dataset, three algorithms on it for a short while, the score table, the curves as a picture.
demo: $(STAMP)
	BIN=$(BIN) sh docs/demo.sh

test: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist worksteal

# More of what is random in the tests of faults: kills in all, and spoiled files for each reader. Each run tries others,
# so that many short runs (KILLS=100 FUZZ=10000) are as good as a long one.
KILLS ?= 1000
FUZZ ?= 100000
nightly: $(STAMP)
	OFFBENCH_KILLS=$(KILLS) OFFBENCH_FUZZ=$(FUZZ) $(BIN)/python -m pytest -v -n auto --dist worksteal \
		tests/faults/test_kill.py tests/faults/test_fuzz.py -k "kill_9 or many"

# MuJoCo versions that the tests replay shipped transitions on, each in a folder of its own.
MUJOCO_VERSIONS := 3.2.3 3.4.0 3.5.0 4.0.0
mujoco-versions: $(MUJOCO_VERSIONS:%=.mujoco/%)

.mujoco/%: $(STAMP)
	rm -rf $@ $@.part
	$(BIN)/python -m pip install -q --no-deps --target $@.part mujoco$(if $(filter 4.%,$*),-core)==$*
	mv $@.part $@

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# Speed against others and against the machine, into docs/benchmarks-KIND.md. d3rlpy and JAX have an environment of their own.
bench: $(STAMP) .venv-peers/pins.txt
	$(BIN)/python -m pip install -q -c constraints.txt "minari[create]"
	$(BIN)/python -m tests.speed

.venv-peers/pins.txt: tests/speed/peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install -q -r tests/speed/peers.txt
	cp tests/speed/peers.txt $@

# The site of docs/, into site/; a broken link or a page left out of the contents stops it.
docs: $(STAMP)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

clean:
	rm -rf $(VENV) .venv-peers .mujoco build dist *.egg-info demo site
