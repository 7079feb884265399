# Two commands do everything on a fresh machine:
#   make run     create .venv, install, run the main job on the built-in scene
#   make test    the same environment with the development extra, then lint, types and tests
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# pip writes no byte code: Python compiles a module at its first import, and most installed modules are never imported.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# Where torch's builds for the CPU are: on Linux pip's own choice brings CUDA, some gigabytes. `make TORCH_INDEX= run` leaves
# the choice to pip; so does a machine that cannot reach the place, unless a build lies where pip is told to look.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH = test -z "$(TORCH_INDEX)" || $(PIP) --retries 0 --timeout 15 --index-url "$(TORCH_INDEX)" torch \
	|| echo "== found no torch for the CPU at $(TORCH_INDEX): pip takes its own choice"

# Python files are compiled once, whatever the environment says: every process that a test starts loads them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test test-all everything fuzz style lint conf clean

run: $(VENV)/.installed
	@echo "== dhtorch on the built-in scene"
	$(BIN)/dhtorch $(ARGS)
	@echo "== The table: depth beyond the cutoff was hidden and recovered. coverage: share of samples with an answer;"
	@echo "   median and p90: relative error of the answers; > 20 % off: share of answers that are wrong by more."
	@echo "== Next, your own capture:  . $(BIN)/activate && dhtorch PATH     (or without activating: $(BIN)/dhtorch PATH)"
	@echo "   A demo with a 3D page: dhtorch demo. All commands: dhtorch --help"

test: $(VENV)/.installed-dev style
	@echo "== tests, and types beside them (real sequences: $${DHTORCH_DATA:-DHTORCH_DATA is unset, their tests skip})"
	@$(BIN)/mypy >$(VENV)/types.log 2>&1 & types=$$!; \
	$(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS); tests=$$?; \
	wait $$types; types=$$?; echo "== types"; cat $(VENV)/types.log; exit $$((tests | types))
	@echo "== done; nothing was written outside $(VENV), the caches and temporary folders"

# Everything that can be tested on one machine, in an environment of its own: the peers (Ray, Rerun, COLMAP, Open3D) are
# large. Open3D needs Debian's libusb-1.0-0 and the pages are looked at in Debian's chromium.
test-all:
	@$(MAKE) VENV=$(if $(filter file,$(origin VENV)),.venv-all,$(VENV)) everything

everything: $(VENV)/.installed-all lint
	@echo "== all tests, the slow ones too (real sequences: $${DHTORCH_DATA:-DHTORCH_DATA is unset, their tests skip})"
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "" $(ARGS)

# Hostile files of every format: a suite of its own, within ten minutes; ARGS=--full for 20,000 cases.
fuzz: $(VENV)/.installed-dev
	@echo "== hostile files"
	$(BIN)/python benchmarks/fuzz.py $(ARGS)

style: $(VENV)/.installed-dev
	@echo "== lint, format"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

lint: style
	@echo "== types"
	$(BIN)/mypy

# The settings of the methods, written from their records.
conf: $(VENV)/.installed
	$(BIN)/python docs/settings.py

# Compiled operators, where there is a C++ compiler; torch computes the same without.
OPS = $(BIN)/python -m dhtorch.ops || echo "== operators are not compiled: torch computes instead"

$(VENV)/.installed: pyproject.toml constraints.txt
	@echo "== installing into $(VENV)"
	$(PYTHON) -m venv $(VENV)
	@$(TORCH)
	$(PIP) -e .
	@$(OPS)
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	@echo "== installing into $(VENV), with what tests and benchmarks need"
	$(PYTHON) -m venv $(VENV)
	@$(TORCH)
	$(PIP) -e .
	@($(OPS)) & ops=$$!; $(PIP) -e ".[dev]"; pip=$$?; wait $$ops; exit $$pip  # compiles beside the downloads
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-all: $(VENV)/.installed-dev
	@echo "== installing into $(VENV), with all that is read or written by other packages"
	$(PIP) -e ".[dev,peers,scale,view]"
	@touch $@

clean:
	rm -rf $(VENV) .venv-all .pytest_cache .mypy_cache .ruff_cache build dist
