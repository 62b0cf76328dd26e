# Two commands are all a newcomer needs: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
RUN    := runs/demo

.PHONY: help demo test docs check format scenes versions bench clean

help:            ## list the commands
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 18

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "viapoint needs Python 3.11 or newer; name one with: make PYTHON=python3.12")'
	@echo "making the virtual environment in $(VENV) (once, about two minutes)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: $(READY)   ## train, evaluate, draw and film an agent
	@$(BIN)/viapoint demo --out $(RUN)

test: $(READY)   ## the whole test suite
	@$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder --quiet

docs: $(READY)   ## this site, without warnings, in docs/_build/html
	@$(BIN)/sphinx-build --fail-on-warning --keep-going --nitpicky --quiet docs docs/_build/html

check: $(READY)  ## format, lint, strict types and docstrings
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/python -m pytest --quiet tests/test_docs.py -k docstrings_begin

format: $(READY) ## let ruff put the source in order
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

scenes: $(READY) ## make the frozen scenes again, and count those that are as they ship
	@$(BIN)/python benchmarks/frozen_scenes.py --check

versions: $(READY) ## the suite with the oldest versions that are allowed, in an environment of its own
	@$(BIN)/python benchmarks/versions.py oldest

bench: $(READY)  ## throughput as ratios
	@$(BIN)/python benchmarks/speed.py

clean:           ## remove the virtual environment, caches and runs
	rm -rf $(VENV) runs build dist docs/_build docs/api docs/environments docs/project *.egg-info .mypy_cache .pytest_cache .ruff_cache
