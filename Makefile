# Two commands do everything: `make run` and `make test`. Each sets up .venv first, once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TORCH := torch==2.13.0
# Without an NVIDIA GPU the CPU build of torch is what you want: it is ten times smaller. On Linux only torch's own
# index has it by that name; where that index cannot be reached, pip's usual sources are asked.
CPU_INDEX := https://download.pytorch.org/whl/cpu
PIP := $(BIN)/python -m pip --disable-pip-version-check
RUN_ARGS ?=
TEST_ARGS ?=

.PHONY: help install run test check docs format bench clean
.DEFAULT_GOAL := help

help: ## show this
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(VENV)/.installed ## build .venv with everything that `rapid` needs

run: $(VENV)/.installed ## the whole job: collect, distil, adapt, measure, report (RUN_ARGS="--scale tiny")
	$(BIN)/rapid run $(RUN_ARGS)

test: $(VENV)/.installed-dev ## run the tests (TEST_ARGS="-k simulator")
	$(BIN)/python -m pytest $(TEST_ARGS)

check: $(VENV)/.installed-dev ## format, lint and type checks
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

docs: $(VENV)/.installed-dev ## build the documentation site into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build -q
	@echo 'Open build/site/index.html'

format: $(VENV)/.installed-dev ## rewrite the code as `make check` wants it
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(VENV)/.installed-dev ## measure speed against the reference implementations
	$(BIN)/python benchmarks/simulator.py

clean: ## remove .venv and caches, never runs
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else f"Python 3.11 or newer is needed, but $(PYTHON) is {sys.version.split()[0]}. Install one and say: make PYTHON=python3.11 $(MAKECMDGOALS)")'
	@$(PYTHON) -m venv $(VENV) || { echo 'Cannot make a virtual environment. On Debian and Ubuntu: apt-get install python3-venv'; exit 2; }
	@touch $@

$(VENV)/.torch: $(VENV)/.python constraints.txt
	@echo 'Installing torch ...'
	@if [ "$$(uname -s)" = Linux ] && ! command -v nvidia-smi >/dev/null 2>&1; then \
	  $(PIP) install -qq --retries 0 --timeout 20 --no-deps --index-url $(CPU_INDEX) $(TORCH) 2>/dev/null \
	  || { echo 'The index of CPU builds cannot be reached; asking the usual sources (the file may be large).'; \
	       $(PIP) install -qq -c constraints.txt $(TORCH); }; \
	else $(PIP) install -qq -c constraints.txt $(TORCH); fi
	@touch $@

$(VENV)/.installed: $(VENV)/.torch pyproject.toml constraints.txt
	@echo 'Installing RAPID and what it needs ...'
	@$(PIP) install -qq -c constraints.txt -e .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo 'Installing the development tools ...'
	@$(PIP) install -qq -c constraints.txt -e '.[dev,minari,export,sb3,ray,docs]'
	@touch $@
