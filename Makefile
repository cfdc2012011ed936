# Two commands for users, `make run` and `make test`; two for developers, `make check` and `make bench`.
# Each creates `.venv` when there is none and installs what constraints.txt pins; the benchmarks have `.venv-bench`,
# with the packages that they compare with (constraints-bench.txt), so that `.venv` stays as it is tested.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
BENCH_VENV := .venv-bench
BENCH_BIN := $(BENCH_VENV)/bin
# What pytest or the benchmarks are given besides, e.g. `make test PYTEST_ARGS=tests/test_profiles.py`.
PYTEST_ARGS ?=
BENCH_ARGS ?=
RUN_OUT ?= results/paper

PIP := -m pip --disable-pip-version-check install --quiet
SOURCES := pyproject.toml constraints.txt
# One script for each hot path; the others are studies of accuracy that take minutes to an hour.
HOT := deflection chi2_gradient lens_equation strong_fit map_render ks akra shape_noise lambda_monte_carlo reproduce
STUDIES := $(filter-out $(HOT) table,$(basename $(notdir $(wildcard benchmarks/[!_]*.py))))

.PHONY: help run test test-long check format bench bench-studies clean

help:
	@echo "make run    repeat the paper: simulate, fit, reconstruct, compare; write $(RUN_OUT)"
	@echo "make test   formatting, lint, types and all tests"
	@echo "make test-long  the dearest tests, most notebooks among them"
	@echo "make check  formatting, lint and types alone"
	@echo "make format rewrite the sources in the project's format"
	@echo "make bench  speed of every hot path, and the table of ratios (BENCH_ARGS=--smoke: small sizes)"
	@echo "            in $(BENCH_VENV), which has the packages that are compared with"
	@echo "make bench-studies  accuracy on real and simulated clusters; takes hours"

run: $(VENV)/.installed
	$(BIN)/jaxlens reproduce --out $(RUN_OUT)

test: check
	$(BIN)/python -m pytest -n auto --maxprocesses 4 $(PYTEST_ARGS)

test-long: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n auto --maxprocesses 4 -m long $(PYTEST_ARGS)

check: $(VENV)/.installed-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright

format: $(VENV)/.installed-test
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

# A script whose check fails does not stop the others. The table fails if its results do not belong together.
bench: $(BENCH_VENV)/.installed
	failed=""; for name in $(HOT); do \
	    $(BENCH_BIN)/python benchmarks/$$name.py $(BENCH_ARGS) || failed="$$failed $$name"; done; \
	$(BENCH_BIN)/python benchmarks/table.py $(filter --smoke,$(BENCH_ARGS)) || failed="$$failed table"; \
	if [ -n "$$failed" ]; then echo "checks failed in:$$failed"; exit 1; fi

bench-studies: $(BENCH_VENV)/.installed
	failed=""; for name in $(STUDIES); do \
	    $(BENCH_BIN)/python benchmarks/$$name.py $(BENCH_ARGS) || failed="$$failed $$name"; done; \
	if [ -n "$$failed" ]; then echo "checks failed in:$$failed"; exit 1; fi

clean:
	rm -rf $(VENV) $(BENCH_VENV)

%/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "jaxlens needs Python 3.11 or newer; say which with: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv $*

$(VENV)/.installed: $(SOURCES) | $(BIN)/python
	$(BIN)/python $(PIP) -c constraints.txt -e .
	@touch $@

$(VENV)/.installed-test: $(SOURCES) | $(BIN)/python
	$(BIN)/python $(PIP) -c constraints.txt -e ".[test]"
	@touch $@ $(VENV)/.installed

$(BENCH_VENV)/.installed: $(SOURCES) constraints-bench.txt | $(BENCH_BIN)/python
	$(BENCH_BIN)/python $(PIP) -c constraints-bench.txt -e ".[bench,sample,test]"
	@touch $@
