# SPDX-License-Identifier: Apache-2.0
# make demo   everything from nothing: environment, weights, a sequence, the main job
# make test   the tests
# make fuzz   damaged input for every reader and parser; CASES of each, 1,000 unless said
# make docs   the site of the documentation, in site/
# make check-dist   wheel and sdist, checked; PYTHONS="python3.10 ..." also installs the wheel

PYTHON ?= python3
PYTHONS ?=
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
SOURCES := pyproject.toml constraints.txt README.md LICENSE \
	$(shell find slamdepth -type f -not -name '*.pyc' -not -name '.*')

.PHONY: demo test fuzz lint types layers check docs dist check-dist install install-dev install-docs format clean

demo: install
	$(BIN)/slamdepth weights pull
	$(BIN)/slamdepth synth demo/room
	$(BIN)/slamdepth run demo/room --depth dinov2 --output demo/run --overwrite

test: install-dev
	$(BIN)/pytest --numprocesses auto --maxprocesses 4
	SLAMDEPTH_COMPILED=0 $(BIN)/pytest tests/test_features.py tests/test_matching.py tests/test_metric.py \
		tests/test_moving_things.py tests/test_pose.py tests/test_tracker.py

CASES ?= 1000
SEED ?= 0
fuzz: install-dev
	$(BIN)/python tests/fuzz.py --cases $(CASES) --seed $(SEED)

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install-dev
	$(BIN)/mypy

layers: install-dev
	$(BIN)/lint-imports

check: lint types layers test

docs: install-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

dist: $(VENV)/.dist
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*

check-dist: dist
	$(BIN)/python .ci/check_dist.py dist $(if $(PYTHONS),--install $(PYTHONS))

format: install-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(VENV)/.package
install-dev: $(VENV)/.dev
install-docs: $(VENV)/.docs

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.package: $(SOURCES) | $(BIN)/python
	$(PIP) .
	touch $@

$(VENV)/.dev: $(VENV)/.package
	$(PIP) '.[dev]'
	touch $@

$(VENV)/.dist: | $(BIN)/python
	$(PIP) 'build>=1.2,<2' 'twine>=6,<8'
	touch $@

$(VENV)/.docs: $(VENV)/.package
	$(PIP) '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) demo site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
