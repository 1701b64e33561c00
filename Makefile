# The commands of this project; each sets up .venv by itself, from constraints.txt.
PYTHON ?= python3
BIN := .venv/bin
TRAIN ?= --env highway-v0 --repr esc
BENCH ?= --batch --end-to-end --planning --out docs/speed.md --readme README.md
WORKERS ?= 2

SOAK ?= --steps 1000000 --out docs/reliability.md

.PHONY: setup train test slow exact bench drill soak lint
setup: .venv/.done

.venv/.done: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

train: setup
	$(BIN)/esc-train $(TRAIN)

test: setup
	$(BIN)/pytest -n $(WORKERS) --dist loadgroup

slow: setup
	$(BIN)/pytest -n $(WORKERS) --dist loadgroup -m slow

exact: setup
	$(BIN)/pytest tests/esc_gym/fastsim/test_exactness.py tests/esc_gym/vector/test_configurations.py \
		--exact-seeds 100 -n $(WORKERS) -m ''

bench: setup
	$(BIN)/pytest tests/benchmarks --benchmark-enable -o norecursedirs=.* -s
	$(BIN)/esc-bench $(BENCH)

drill: setup
	$(BIN)/python -m esc_agents.cli.drill

soak: setup
	$(BIN)/python -m esc_agents.cli.soak $(SOAK)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
