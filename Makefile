# Each target installs its dependencies into .venv. PYTHON=python3.12 make ... selects another Python (3.11 or newer).
PYTHON ?= python3
BIN := .venv/bin
# An editable install contains the path of the checkout: reinstall if the checkout was moved.
HERE := $(shell pwd | cksum | cut -d' ' -f1)
RUNTIME := .venv/.runtime-$(HERE)
DEV := .venv/.dev-$(HERE)
BENCH := .venv/.bench-$(HERE)
PIP = $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

.PHONY: help demo test test-full system-test check conditions schemas bench paper screens clean

help:
	@echo "make demo    run the simulated machine and the daemon for 90 s, and compare"
	@echo "make test    run the tests, long ones left out: six minutes on two cores"
	@echo "make test-full"
	@echo "             the long tests, and those that time something, one at a time: half an hour"
	@echo "make system-test"
	@echo "             as root on Debian: drivers against can-utils, systemd and libmodbus, in a guest that is booted"
	@echo "make check   ruff, mypy --strict, import rules"
	@echo "make conditions"
	@echo "             write the pages docs/conditions.md and docs/conditions.de.md anew"
	@echo "make schemas"
	@echo "             write docs/reference/schemas anew: JSON Schema of what daemons publish"
	@echo "make bench   print the benchmarks"
	@echo "make paper   the scenarios of the paper: our figures beside the paper's, with plots"
	@echo "make screens pictures and texts of every screen, for the docs, from one seeded run"
	@echo "make clean   remove .venv and caches"

demo: $(RUNTIME)
	$(BIN)/python -m otolith demo

# Tests start hundreds of processes, each of which would compile the sources again.
unexport PYTHONDONTWRITEBYTECODE

# More processes than cores, as many tests wait for real time. A file's tests stay together and share what they compute.
WORKERS ?= $(shell expr 2 \* $$(nproc))
SHARED = $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadscope --no-loadscope-reorder
test: $(DEV)
	$(SHARED) -m "not full and not timed"

# Timed tests run last and one at a time, with exact limits; only files that name the marker are read for them.
# LONG="not timed" runs the tests of make test as well.
LONG = full and not timed
TIMED = grep -rli --include='test_*.py' --exclude-dir=vm timed tests
test-full: $(DEV)
	@$(SHARED) -m "$(LONG)"; shared=$$?; \
	OTOLITH_TIMING=exact $(BIN)/python -m pytest -m timed $$($(TIMED)); timed=$$?; exit $$((shared | timed))

system-test: $(DEV)
	@PYTHON=$(BIN)/python tests/vm/all.sh

check: $(DEV)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# The pages of conditions in docs, from the rules of the diagnosis and their texts.
conditions: $(DEV)
	$(BIN)/python -m otolith explain --markdown --language en > docs/conditions.md
	$(BIN)/python -m otolith explain --markdown --language de > docs/conditions.de.md

# What readers of other programs check documents with; 'otolith schema' prints the same.
schemas: $(DEV)
	for kind in $$($(BIN)/python -m otolith schema | cut -d " " -f 1); do \
	  $(BIN)/python -m otolith schema $$kind > docs/reference/schemas/$$kind.json || exit 1; done

bench: $(BENCH)
	@for file in benchmarks/bench_*.py; do echo "== $$file"; $(BIN)/python -m benchmarks.$$(basename $$file .py) || exit 1; done

paper: $(DEV)
	$(BIN)/python -m benchmarks.paper

screens: $(DEV)
	$(BIN)/python -m benchmarks.screens

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is missing or older than 3.11: set PYTHON=python3.12 or the like"; exit 2; }
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "on Debian: apt install python3-venv"; exit 2; }

$(RUNTIME): pyproject.toml constraints.txt | .venv/bin/python
	@echo "setting up .venv, which takes a minute or two"
	@$(PIP) --editable .
	@touch $@

$(DEV): pyproject.toml constraints.txt | .venv/bin/python
	@echo "setting up .venv with the test tools, which takes a minute or two"
	@$(PIP) --editable '.[dev]'
	@touch $@ $(RUNTIME)

$(BENCH): pyproject.toml constraints.txt | .venv/bin/python
	@echo "setting up .venv with what the benchmarks compare with, which takes a minute or two"
	@$(PIP) --editable '.[dev,bench]'
	@touch $@ $(RUNTIME) $(DEV)
