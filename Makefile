# Works on a fresh machine with Python 3.11 or later and make; everything goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: help demo test lint coverage check trips clean

help:
	@echo "make demo      the whole job on the shipped log: fit, bus, service, report"
	@echo "make test      the whole test suite"
	@echo "make lint      ruff and mypy"
	@echo "make coverage  the test suite with coverage"
	@echo "make check     a small part of the withheld check of the diagnosis"
	@echo "make trips     the table on the real BMW i3 trips (see README for the data)"

$(VENV)/installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("cangauge needs Python 3.11 or later (set PYTHON=…)" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

demo: $(VENV)/installed
	$(BIN)/cangauge demo

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest

lint: $(VENV)/installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

coverage: $(VENV)/installed-dev
	$(BIN)/python -m pytest --cov --cov-report=term-missing:skip-covered

check: $(VENV)/installed
	$(BIN)/cangauge gap-check --part small

trips: $(VENV)/installed
	$(BIN)/python benchmarks/real_trips.py

clean:
	rm -rf $(VENV) out
