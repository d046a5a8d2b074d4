# The one list of commands. `make run` and `make test` set themselves up. `make stress` runs many random scenes, and the
# tests whose statistics take few of their cases in the suite.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Python compiles what it imports when it imports it first, which takes 11 s less than all that is installed.
INSTALL := $(BIN)/pip install --quiet --no-compile --disable-pip-version-check
DECK ?= circuits/fingerpad.cir

# Levels of instructions for which `make wheel` compiles.
LEVELS ?= $(if $(filter x86_64,$(shell uname -m)),x86-64-v3 x86-64-v2,generic)

.PHONY: run wheel test check docs figures fuzz stress clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# Stamps: what is installed, and from which pyproject.toml.
$(VENV)/.run: pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV), half a minute ..."
	$(INSTALL) --editable .
	touch $@

$(VENV)/.check: pyproject.toml | $(BIN)/python
	$(INSTALL) --editable '.[check]'
	touch $@

# The pinned torch first: an open range would bring a build for graphics cards.
$(VENV)/.test: pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV); torch is most of it ..."
	$(INSTALL) torch==2.13.0
	$(INSTALL) --editable '.[test]'
	touch $@

$(VENV)/.docs: pyproject.toml | $(BIN)/python
	$(INSTALL) --editable '.[docs]'
	touch $@

run: $(VENV)/.run
	$(BIN)/fingerspice run $(DECK) --out out

# A wheel with all compiled code (docs/installing.md), out/dist/*.whl; five minutes a level on two cores.
wheel: $(VENV)/.run
	rm -rf out/objects out/dist
	for level in $(LEVELS); do echo "compiling for $$level ..."; NUMBA_CACHE_DIR=out/objects \
	    NUMBA_CPU_NAME=$$level NUMBA_CPU_FEATURES= $(BIN)/fingerspice warm || exit 1; done
	OBJECTS=out/objects $(BIN)/pip wheel --quiet --no-deps --wheel-dir out/dist .
	@ls -l out/dist

figures: $(VENV)/.run
	$(BIN)/fingerspice figures --out out

test: $(VENV)/.test
	@sh tests/get_programs.sh
	@echo "running the whole suite: 7 minutes on two cores, and about 3 more where nothing is compiled yet"
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal

stress: $(VENV)/.test
	$(BIN)/python tests/stress.py --scenes 10000 --json benchmarks/results/stress.json
	STRESS=1 $(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal $$(grep -lE '\b(cases|by_turns)\(' tests/test_*.py)

fuzz: $(VENV)/.test
	$(BIN)/python tests/fuzz.py --inputs 1000000

check: $(VENV)/.check docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation as a site, out/docs/index.html; a warning, such as a link that leads nowhere, is an error.
docs: $(VENV)/.docs
	$(BIN)/sphinx-build --builder html --fail-on-warning --keep-going --quiet docs out/docs

clean:
	rm -rf $(VENV) out docs/gallery .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
