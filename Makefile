# Umbra: every target makes the environment that it needs, in .venv; quick from the second time on.
# With uv on the machine uv does it, else Python's own venv and pip. PYTHON=... picks the Python.

VENV := .venv
BIN := $(VENV)/bin
UV := $(shell command -v uv 2>/dev/null)
PYTHONS := $(PYTHON) python3 python3.13 python3.12 python3.11
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
ARGS ?=

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1

.PHONY: help demo test lint format bench docs clean

help:  ## say what there is
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):[^#]*## (.*)/make \1\t\2/' | expand -t 16

demo: $(VENV)/.runtime  ## a scan on the virtual rig, with its result in demo-out
	$(BIN)/umbra demo -o demo-out --force $(ARGS)

# One more than there are cores: tests of real processes wait at times, and another may compute then.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)

test: $(VENV)/.dev  ## the whole suite; ARGS="-k name" for a part of it
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

lint: $(VENV)/.dev  ## ruff, mypy and the import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.dev  ## let ruff sort imports and lay out the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.dev  ## the promises as ratios: a table, and bench.json
	$(BIN)/python -m tests.benchmarks $(ARGS)

extra-%: $(VENV)/.dev
	$(call install,.[$*])

clean:  ## remove all that the other targets made
	rm -rf $(VENV) demo-out bench.json build dist *.egg-info
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# ---------------------------------------------------------------- the environment

# A stamp for each set of packages: pyproject.toml newer than the stamp installs again. An
# environment that is there and runs is kept; one whose Python is gone is made anew.
$(VENV)/.runtime: pyproject.toml
	$(call environment)
	$(call install,.)
	@touch $@

$(VENV)/.dev: pyproject.toml
	$(call environment)
	$(call install,.[dev])
	@touch $@ $(VENV)/.runtime

define environment
@if ! $(BIN)/python -c '$(NEW_ENOUGH)' 2>/dev/null; then \
    rm -rf $(VENV); \
    if [ -n "$(UV)" ]; then \
        echo "making $(VENV) with uv"; exec $(UV) venv --quiet --python '$(or $(PYTHON),>=3.11)' $(VENV); \
    fi; \
    for python in $(PYTHONS); do \
        if "$$python" -c '$(NEW_ENOUGH)' 2>/dev/null; then \
            echo "making $(VENV) with $$("$$python" --version)"; \
            "$$python" -m venv $(VENV) && exit 0; \
            rm -rf $(VENV); \
            echo "Umbra: $$python cannot make an environment; install its venv package (Debian: apt install python3-venv) or uv" >&2; \
            exit 1; \
        fi; \
    done; \
    echo "Umbra needs Python 3.11 or newer, and found only $$(python3 --version 2>/dev/null || echo none); install one, or uv, or say make PYTHON=/path/to/python" >&2; \
    exit 1; \
fi
endef

define install
@echo "installing $(1)"
@if [ -n "$(UV)" ]; then \
    $(UV) pip install --quiet --python $(BIN)/python -e '$(1)'; \
else \
    $(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null; \
    $(BIN)/python -m pip install --quiet -e '$(1)'; \
fi
endef
