# Two commands do everything on a fresh machine:
#   make run     create .venv, install, run the main job on the built-in scene
#   make test    the same environment with the development extra, then lint, types and tests
PYTHON ?= python3
VENV ?= .venv
LEROBOT ?= .venv-lerobot
BIN := $(VENV)/bin
# pip writes no byte code: Python compiles a module at its first import, and most installed modules are never imported.
INSTALL := -m pip install --quiet --disable-pip-version-check --no-compile
PIP := $(BIN)/python $(INSTALL) -c constraints.txt

# Where torch's builds for the CPU are: on Linux pip's own choice brings CUDA, some gigabytes. `make TORCH_INDEX= run` leaves
# the choice to pip; so does a machine that cannot reach the place, unless a build lies where pip is told to look.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH = test -z "$(TORCH_INDEX)" || $(1) --retries 0 --timeout 15 --index-url "$(TORCH_INDEX)" $(2) \
	|| echo "== found no torch for the CPU at $(TORCH_INDEX): pip takes its own choice"

# Python files are compiled once, whatever the environment says: every process that a test starts loads them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test test-all everything lerobot system fuzz style lint conf clean

run: $(VENV)/.installed
	@echo "== dhtorch on the built-in scene"
	$(BIN)/dhtorch run $(ARGS)
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

# Everything that can be tested on one machine, in environments of its own: the peers (Ray, Rerun, COLMAP, Open3D) are
# large, and LeRobot's releases exclude the torch of constraints.txt.
test-all:
	@$(MAKE) -k VENV=$(if $(filter file,$(origin VENV)),.venv-all,$(VENV)) everything lerobot

everything: system $(VENV)/.installed-all lint
	@echo "== all tests, the slow ones too (real sequences: $${DHTORCH_DATA:-DHTORCH_DATA is unset, their tests skip})"
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "" $(ARGS)

lerobot: $(LEROBOT)/.installed $(VENV)/.installed-dev
	@echo "== LeRobot: clients, integrations/lerobot"
	$(LEROBOT)/bin/python -m pytest tests/test_clients.py -k "step and lerobot"
	$(BIN)/python benchmarks/clients/lerobot_plugin.py --lerobot $(LEROBOT)/bin/python

# Debian's packages that tests use, where they can be had: the browser of pages and the USB library that Open3D loads.
APT := apt-get -qq -o Acquire::Retries=0 -o Acquire::http::Timeout=15 -o DPkg::Lock::Timeout=60
system:
	@test "$$(id -u)" = 0 && command -v apt-get >/dev/null && { $(APT) update; \
	DEBIAN_FRONTEND=noninteractive $(APT) install -y --no-install-recommends chromium libusb-1.0-0; } >/dev/null 2>&1 \
	|| echo "== apt-get did not install chromium and libusb-1.0-0: without a browser the tests of pages skip"

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
	@$(call TORCH,$(PIP),torch)
	$(PIP) -e .
	@$(OPS)
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	@echo "== installing into $(VENV), with what tests and benchmarks need"
	$(PYTHON) -m venv $(VENV)
	@$(call TORCH,$(PIP),torch)
	$(PIP) -e .
	@($(OPS)) & ops=$$!; $(PIP) -e ".[dev]"; pip=$$?; wait $$ops; exit $$pip  # compiles beside the downloads
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-all: $(VENV)/.installed-dev
	@echo "== installing into $(VENV), with all that is read or written by other packages"
	$(PIP) -e ".[dev,matchers,peers,scale,view]"
	$(PIP) jaxtyping tensorboard tyro viser  # which nerfstudio's parsers import
	$(PIP) --no-deps hydra-ray-launcher nerfstudio openpi-client  # their pins exclude ours, and tests need little of them
	@touch $@

$(LEROBOT)/.installed: pyproject.toml
	@echo "== installing into $(LEROBOT)"
	$(PYTHON) -m venv $(LEROBOT)
	@$(call TORCH,$(LEROBOT)/bin/python $(INSTALL),"torch<2.11" torchvision)
	$(LEROBOT)/bin/python $(INSTALL) -e . "lerobot[training]" pytest pytest-timeout nbmake
	@touch $@

clean:
	rm -rf $(VENV) .venv-all $(LEROBOT) .pytest_cache .mypy_cache .ruff_cache build dist
