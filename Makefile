# The commands of this project; each sets up .venv by itself, from constraints.txt.
PYTHON ?= python3
BIN := .venv/bin
# 1,500 steps until the simulator is accelerated: highway-v0 makes a few steps a second.
TRAIN ?= --env highway-v0 --repr esc --steps 1500 --evaluation.episodes 4
WORKERS ?= 2

.PHONY: setup train test bench lint
setup: .venv/.done

.venv/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

train: setup
	$(BIN)/esc-train $(TRAIN)

test: setup
	$(BIN)/pytest -n $(WORKERS)

bench: setup
	$(BIN)/pytest tests/benchmarks --benchmark-enable -o norecursedirs=.* -s

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
