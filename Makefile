# Two commands do everything on a fresh machine:
#   make run     create .venv, install, run the main job on the built-in scene
#   make test    the same environment with the development extra, then lint, types and tests
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: run test lint clean

run: $(VENV)/.installed
	@echo "== dhtorch on the built-in scene"
	$(BIN)/dhtorch $(ARGS)

test: $(VENV)/.installed-dev lint
	@echo "== tests (real sequences: $${DHTORCH_DATA:-DHTORCH_DATA is unset, their tests skip})"
	$(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)
	@echo "== done; nothing was written outside $(VENV), the caches and temporary folders"

lint: $(VENV)/.installed-dev
	@echo "== lint, format, types"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/.installed: pyproject.toml constraints.txt
	@echo "== installing into $(VENV)"
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt
	@echo "== installing into $(VENV), with what tests and benchmarks need"
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e ".[dev]"
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache build dist
