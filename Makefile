# Works on a fresh machine with Python 3.11 or later and make; everything goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# Where SocketCAN is not to be had directly, a command that provides it.
SOCKETCAN ?= $(wildcard ../shared/tools/with-socketcan)

# Folder of the recorded logs (see README for their sources).
DATA ?= $(wildcard ../shared/data)

.PHONY: packs help demo test socketcan nightly lint coverage check data faults bench bench-check lowest site wheel clean

help:
	@echo "make demo      the whole job on the shipped log: fit, bus, service, report"
	@echo "make test      the whole test suite"
	@echo "make socketcan the tests that need a real SocketCAN interface"
	@echo "make nightly   what is too long for the suite (PART=inputs|process|faults|grade|suite|tests|lowest|long|load|vcan, DATA=FOLDER)"
	@echo "make lint      ruff and mypy"
	@echo "make coverage  the test suite with coverage"
	@echo "make check     a small part of the withheld check of the diagnosis"
	@echo "make faults    the table of faults on a live bus (prints the expected time first)"
	@echo "make lowest    the lowest versions that pyproject.toml allows, on every Python here (or PYTHONS=…)"
	@echo "make site      the documentation as a site, in out/site"
	@echo "make wheel     build the wheel and run the job from it in an environment of its own"
	@echo "make bench     time and accuracy beside other packages, and how the cost grows (DATA=FOLDER, see README)"
	@echo "make packs     SoC errors on recorded packs, with models from few logs (DATA=FOLDER)"

# Bytecode of what runs, with all cores; pip compiles the packages' own tests too, with one.
define install
$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable '$(1)'
$(BIN)/python -m compileall -q -j 0 -x '/tests?/' $(VENV)/lib
endef

$(VENV)/installed: pyproject.toml hatch_build.py $(wildcard core/*.[ch])
	$(PYTHON) -c 'import sys; sys.exit("cangauge needs Python 3.11 or later (set PYTHON=…)" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(call install,.[live])
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(call install,.[dev])
	touch $@

# Exactly the versions of .ci/nightly.txt, by their hashes (Python 3.11 on Linux, x86-64); elsewhere the latest.
$(VENV)/installed-nightly: $(VENV)/installed-dev .ci/nightly.txt
	.ci/pinned $(BIN)/python || { echo "NOT PINNED: .ci/nightly.txt is of another platform" >&2; $(BIN)/python -m pip install --quiet --editable '.[nightly]'; }
	touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(call install,.[docs])
	touch $@

demo: $(VENV)/installed
	$(BIN)/cangauge demo

# A worker more than cores, since some tests wait for other programs. The tests of a file stay
# together: they share what is slow to prepare.
test: WORKERS = $(shell $(BIN)/python -c 'import os; print(os.cpu_count() + 1)')
# Matrices are small: where every worker's linear algebra has a thread a core, they wait for each other.
test: export OMP_NUM_THREADS := 1
test: export OPENBLAS_NUM_THREADS := 1
# Entry points of Hypothesis import trio, which no test uses.
test: export HYPOTHESIS_NO_PLUGINS := 1
# The tests are compiled once, not again in each worker of each run.
test: export PYTHONDONTWRITEBYTECODE :=
test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

# On a kernel without CAN a guest is booted. It says how many tests ran, and fails if none did.
socketcan: $(VENV)/installed-dev
	.ci/socketcan $(BIN)/python $(SOCKETCAN)

nightly: $(VENV)/installed-nightly
	$(BIN)/python benchmarks/nightly.py $(PART) $(if $(DATA),--data "$(DATA)") $(if $(SOCKETCAN),--socketcan "$(SOCKETCAN) -t 3600 -m 2G")

lint: $(VENV)/installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

coverage: $(VENV)/installed-dev
	$(BIN)/python -m pytest --cov --cov-report=term-missing:skip-covered

check: $(VENV)/installed
	$(BIN)/cangauge gap-check --at-most 1

data:
	@test -d "$(DATA)" || { echo "no folder '$(DATA)' of recorded logs: name it, make $(MAKECMDGOALS) DATA=FOLDER (see README for the sources)" >&2; exit 2; }

# The other packages, in an environment of their own.
PEERS := .venv-peers
BENCH := out/bench

$(PEERS)/installed: benchmarks/peers.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	touch $@

bench: export OMP_NUM_THREADS := 1
bench: export OPENBLAS_NUM_THREADS := 1
bench: data $(VENV)/installed-dev $(PEERS)/installed
	mkdir -p $(BENCH)
	$(BIN)/python benchmarks/peers.py --data "$(DATA)" --peers $(PEERS)/bin/python --figure $(BENCH)/peers.png
	$(BIN)/python benchmarks/cost.py

# Fails where a count is 20 % above the kept one.
bench-check: export OMP_NUM_THREADS := 1
bench-check: $(VENV)/installed
	$(BIN)/python benchmarks/counts.py

faults: $(VENV)/installed
	PYTHONPATH=benchmarks $(BIN)/python -m faults $(if $(SOCKETCAN),--socketcan "$(SOCKETCAN) -t 3600 -m 2G")

site: export NO_MKDOCS_2_WARNING := 1
site: $(VENV)/installed-docs
	$(BIN)/python docs/pages.py out/docs
	$(BIN)/zensical build --clean --strict
	@echo "out/site/index.html"

wheel:
	.ci/wheel $(PYTHON)

lowest:
	.ci/lowest $(PYTHONS)

clean:
	rm -rf $(VENV) .venv-lowest $(PEERS) out

packs: $(VENV)/installed
	cd benchmarks && $(abspath $(BIN))/python -m packs --data $(abspath $(DATA)) $(ARGS)
