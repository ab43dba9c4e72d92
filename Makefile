# `make train` and `make test` need python3 (3.11 or later) and a package registry that pip reaches; nothing else.

PYTHON ?= python3
VENV ?= .venv
# Test processes side by side; each holds its own JAX and compiles for itself, and takes the next file in conftest.py's order.  One
# that dies ends the run: pytest-xdist may wait for ever for the rest of a dead process's file.
JOBS ?= 2
PYTEST_ARGS ?= -n $(JOBS) --dist loadfile --no-loadscope-reorder --max-worker-restart=0 --durations=10
ARGS ?= --space grid_world --target A --method apt_gen --preset fast --seeds 0 --run-dir runs/quickstart \
	$(if $(wildcard runs/quickstart/config.json),--resume)
BENCH_ARGS ?=

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := experiments,dev

.DEFAULT_GOAL := help
.PHONY: help install train test lint format peers bench constraints clean

help: ## Say what each command does.
	@grep -hE '^[a-z]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z]+):.*## (.*)/make \1	\2/' | expand -t 20

install: $(STAMP) ## Make .venv and install what constraints.txt pins; the other commands do it by themselves.

train: $(STAMP) ## Train; ARGS="..." says what, by default APT-Gen on Grid-World A, one seed; goes on where it was stopped.
	$(BIN)/python -m experiments.train $(ARGS)

test: lint ## Lint, type-check and run every test.
	$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(STAMP) ## Check style, format and types.
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(STAMP) ## Mend style and format where a tool can.
	$(BIN)/ruff check --fix-only --quiet
	$(BIN)/ruff format

peers: $(STAMP) ## Install what the benchmarks compare with; they leave out what is missing.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS),peers]'

bench: $(STAMP) ## Measure what was not measured at this commit, write BENCHMARKS.md's tables anew; BENCH_ARGS="--only seeds" for some.
	$(BIN)/python -m experiments.benchmarks $(BENCH_ARGS)
	$(BIN)/python -m experiments.document

constraints: ## Pin today's versions in constraints.txt.
	@set -e; tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; \
	$(PYTHON) -m venv "$$tmp/venv"; \
	"$$tmp/venv/bin/python" -m pip install --quiet -e '.[$(EXTRAS)]'; \
	{ grep '^#' constraints.txt; "$$tmp/venv/bin/python" -m pip freeze --exclude-editable | sort -f; } > "$$tmp/constraints.txt"; \
	cp "$$tmp/constraints.txt" constraints.txt

clean: ## Remove .venv, builds and caches; runs/ stays.
	rm -rf $(VENV) build dist *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "error: $(PYTHON) not found; install Python 3.11 or later, or say make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: Python 3.11 or later is needed, $(PYTHON) is $$($(PYTHON) -V 2>&1); say make PYTHON=..." >&2; exit 1; }
	@$(BIN)/python -c 'import pip' 2>/dev/null || $(PYTHON) -m venv --clear $(VENV) || \
		{ rm -rf $(VENV); echo "error: $(PYTHON) -m venv failed; some systems ship it as a package of its own (python3-venv)" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@
