# `make demo` and `make test` are all that a fresh machine needs: python3 with venv, and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
SOURCES := pyproject.toml hatch_build.py $(wildcard scp_mpc/native/*.[ch])

.PHONY: demo test test-all check format bench risk safety soak wind clean

demo: $(VENV)/.demo  ## run the report's four scenarios; tables and pictures go to out/
	$(BIN)/scp-mpc report --out $(OUT)

test: $(VENV)/.dev  ## run the tests that everybody runs
	$(BIN)/python -m pytest

test-all: $(VENV)/.dev  ## the slow ones, too: soak, Monte Carlo, notebooks, large random runs
	$(BIN)/python -m pytest -m ""

check: $(VENV)/.dev  ## lint, format, docstrings, strict types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.dev  ## let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.dev  ## all benchmarks; tables, figures and numbers go to benchmarks/results
	$(BIN)/python benchmarks/run.py --out benchmarks/results

risk: $(VENV)/.dev  ## promised against measured risk, by Monte Carlo
	$(BIN)/python benchmarks/risk.py --out $(OUT)

safety: $(VENV)/.dev  ## random worlds: who is safe and who arrives; stop it and go on as you like
	$(BIN)/python benchmarks/safety.py --kind standing --out $(OUT)
	$(BIN)/python benchmarks/safety.py --kind moving --out $(OUT)

soak: $(VENV)/.dev  ## a million control steps with faults; stop it and go on as you like
	$(BIN)/python benchmarks/soak.py --out $(OUT)

wind: $(VENV)/.dev  ## tracking under wind, with and without disturbance rejection
	$(BIN)/python benchmarks/wind.py --out $(OUT)

clean:
	rm -rf $(VENV) $(OUT) dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(VENV)/.demo: $(SOURCES) | $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[cli]"
	touch $@

$(VENV)/.dev: $(SOURCES) | $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	touch $@ $(VENV)/.demo

$(VENV):
	$(PYTHON) -m venv $(VENV)
