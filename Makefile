# make demo    one experiment of the paper, with its figures       make test    every check and every test
# make lint    the static checks alone                             make clean   removes what the others made
# make docs    the pages, in docs/_build/html; a warning is an error
# make dist    wheel and sdist in dist/, tried in a clean environment outside the checkout
#
# Each target does its own set-up: a virtual environment in .venv, pinned by constraints.txt. It needs Python >= 3.11.
# PyTorch: pip takes its default build, which on Linux brings CUDA libraries (some GB). They are not needed: for the
# smaller CPU build, set PIP_EXTRA_INDEX_URL to PyTorch's index of CPU wheels, as given on its installation page.

PYTHON ?= $(shell for p in python3.11 python3; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)

BIN := .venv/bin
STAMP := .venv/installed
DOCS_STAMP := .venv/docs-installed
PIP_OPTIONS := --disable-pip-version-check $(if $(MAKE_TERMOUT),,--quiet)

DEMO := configs/two_pairs.yaml
DEMO_OUT := results/two_pairs

# Small tensors: with two threads torch is 7 to 20 times slower than with one.
export OMP_NUM_THREADS := 1

.PHONY: demo test lint docs dist clean

demo: $(STAMP)
	$(BIN)/python -m experiments run $(DEMO) --out $(DEMO_OUT)
	@echo "Figures and results are in $(DEMO_OUT)/:" && ls $(DEMO_OUT)

test: lint docs
	$(BIN)/pytest -n 2 --dist loadfile

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-logo
	$(BIN)/pyright

docs: $(DOCS_STAMP)
	$(BIN)/python -m sphinx -b html -E -W --keep-going --quiet docs docs/_build/html
	@echo "The pages are in docs/_build/html/index.html"

# The wheel is built from the sdist, so both are tried.
dist: $(STAMP)
	rm -rf dist
	PIP_CONSTRAINT=$(CURDIR)/constraints.txt $(BIN)/python -m build
	$(BIN)/python tests/try_wheel.py dist/*.whl constraints.txt

.venv: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "torchfsid needs Python 3.11 or newer: make PYTHON=/path/to/python"; exit 1; }
	$(PYTHON) -m venv .venv
	@echo "Installing PyTorch (1/2): a few minutes the first time ..."
	$(BIN)/pip install $(PIP_OPTIONS) -c constraints.txt torch
	@echo "Installing torchfsid and its tools (2/2) ..."
	$(BIN)/pip install $(PIP_OPTIONS) -c constraints.txt -e '.[dev]'
	@touch $@

$(DOCS_STAMP): $(STAMP)
	$(BIN)/pip install $(PIP_OPTIONS) -c constraints.txt -e '.[docs]'
	@touch $@

clean:
	rm -rf .venv dist results docs/_build docs/notebooks .pytest_cache .ruff_cache .import_linter_cache .hypothesis
