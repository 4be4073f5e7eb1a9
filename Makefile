# Needs bash, make and Python 3.11 to 3.13; `make help` lists what can be done.
SHELL := bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.installed
PIP_FLAGS := -qq --disable-pip-version-check
SUITABLE := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))
# The oldest Python and libraries that pyproject.toml admits.
# Extras whose oldest libraries are tested; others join after removing $(OLDEST).
OLDEST_EXTRAS ?= plot,fetch,test
OLDEST := .venv-oldest
READY_OLDEST := $(OLDEST)/.installed
PYTHON_OLDEST ?= python3.11
# Training libraries apart, because RLlib pins an older Gymnasium, whose types are others.
TRAIN := .venv-train
READY_TRAIN := $(TRAIN)/.installed
# Sphinx and its theme apart, since the tests need neither.
DOCS := .venv-docs
READY_DOCS := $(DOCS)/.installed
DOCS_PY := $(DOCS)/bin/python
# Installed before the libraries on top of it, which would take the newest build. May carry options
# of pip, such as an index of builds for the CPU alone.
TORCH ?= torch==2.13.0
# The first suitable Python unless PYTHON names one.
PYTHON ?= python3.13 python3.12 python3.11 python3 python

# A file stays with one process, because its fixtures are shared; each process may take 1 GB.
# tests/conftest.py puts the files that take longest first.
SPREAD := --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
# Tests of what libraries do: files, tables, pictures, environments, command line, kernels, optima,
# and reference results. What the others compute takes the same functions of NumPy and Taichi.
OF_LIBRARIES := cli column_maps compat config doctor drivers envs exogenous export fetch figures geo \
    golden jobs kernels launch malformed matrix named_kernel optimum_solve policy public_api \
    rack_history readme recorder reference report result_table runtime saved simulator stage \
    statistics streams submissions sweep user_file
TRAINING_TESTS := $(wildcard tests/test_training*.py tests/test_learning*.py tests/test_policy*.py \
    tests/test_ray*.py tests/test_offline*.py tests/test_user_functions.py)
TYPED := build/typecheck
SCRIPTS := $(sort $(dir $(wildcard tests/*.py benchmarks/*.py docs/make/*.py docs/site/*.py examples/*.py)))
MAPPED := configs|data|kernels|viz

.PHONY: help demo test test-oldest test-processors test-train fuzz bench lint wheel-test dist docs clean

help: ## List the targets.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(READY) ## Simulate July in New York and California; results in runs/demo.
	$(VENV)/bin/sdc-taichi simulate --site ny,ca --days 31 --start 07-01 --out runs/demo --record runs/demo/hall.rrd

test: $(READY) ## Run the tests that need neither PyTorch, Ray nor Minari; measured files are in SDC_REAL_DATA.
	$(PY) -m pytest $(SPREAD)

# Old libraries warn of what changed in their own dependencies since.
test-oldest: $(READY_OLDEST) ## Run tests of libraries with Python 3.11 and the oldest that are supported.
	$(OLDEST)/bin/python -m pytest $(SPREAD) -W ignore::DeprecationWarning \
	    $(foreach part,$(OF_LIBRARIES),$(wildcard tests/test_$(part)*.py))

test-processors: $(READY) ## Run tests of results as on older processors.
	$(PY) tests/other_processors.py $(SPREAD)

test-train: $(READY_TRAIN) ## Install PyTorch, Ray and Minari, and run the tests of training, jobs on Ray and data sets.
	$(TRAIN)/bin/python -m pytest $(SPREAD) $(TRAINING_TESTS)

fuzz: $(READY) ## Try 3,000 random hostile inputs, in 15 minutes at most; FUZZ holds other options, as --seed 1.
	$(PY) tests/fuzz.py $(FUZZ)

bench: $(READY) ## Measure every speed target; tables, JSON and plot in runs/bench.
	$(PY) benchmarks/bench.py

lint: $(READY) ## Check style, format and types.
	$(PY) -m ruff check
	$(PY) -m ruff format --check
	rm -rf $(TYPED)
	$(PY) -c 'from setuptools import setup; setup()' --quiet build_py --build-lib $(TYPED)
	set -o pipefail; cd $(TYPED) && ../../$(PY) -m mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache \
	    sdc_taichi $(addprefix ../../,$(SCRIPTS)) \
	    | sed -E 's#^sdc_taichi/($(MAPPED))/#\1/#; s#^\.\./\.\./##'

wheel-test: $(READY) ## Build the wheel and run the tests against it, away from the sources.
	.ci/wheel-test $(PY) $(SPREAD)

dist: $(READY) ## Build sdist and wheel into dist, and check them.
	rm -rf dist
	.ci/build $(PY) dist

# DOCS_VERSION names the build in the list of versions, DOCS_SWITCHER is the address of that list.
docs: $(READY_DOCS) ## Build and check the documentation site in build/docs/html.
	rm -rf build/docs/html
	$(DOCS_PY) docs/site/stage.py build/docs/source
	$(DOCS_PY) docs/site/generate.py build/docs/source
	PATH="$(CURDIR)/$(DOCS)/bin:$$PATH" $(DOCS_PY) -m sphinx -q -W -n --keep-going -c docs/site \
	    -b html build/docs/source build/docs/html
	$(DOCS_PY) docs/site/check.py build/docs/html

clean: ## Remove everything that can be built again, the environment included.
	rm -rf $(VENV) $(OLDEST) $(TRAIN) $(DOCS) build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY_TRAIN): $(READY)
	@echo "Installing the training libraries into $(TRAIN) (once, a few minutes at most)"
	@$(PY) -m venv --clear $(TRAIN)
	@$(TRAIN)/bin/python -m pip install $(PIP_FLAGS) $(TORCH)
	@$(TRAIN)/bin/python -m pip install $(PIP_FLAGS) --editable '.[test,onnx,recipes,scale,offline]'
	@touch $@

$(READY_DOCS): $(READY) pyproject.toml
	@echo "Installing what builds the site into $(DOCS) (once, a few minutes at most)"
	@$(PY) -m venv --clear $(DOCS)
	@$(DOCS_PY) -m pip install $(PIP_FLAGS) $(TORCH)
	@$(DOCS_PY) -m pip install $(PIP_FLAGS) --editable '.[docs,train]'
	@touch $@

# Torch in the environment of development, for work on sdc_taichi/learning.
$(VENV)/.installed-train: $(READY)
	@$(PY) -m pip install $(PIP_FLAGS) $(TORCH)
	@$(PY) -m pip install $(PIP_FLAGS) --editable '.[dev,plot,onnx,train]' stable-baselines3
	@touch $@

$(READY_OLDEST): pyproject.toml .ci/lowest_versions.py
	@echo "Installing the oldest supported libraries into $(OLDEST) (once, a few minutes at most)"
	@$(PYTHON_OLDEST) -m venv --clear $(OLDEST)
	@$(OLDEST)/bin/python .ci/lowest_versions.py $(OLDEST_EXTRAS) > $(OLDEST)/constraints.txt
	@$(OLDEST)/bin/python -m pip install $(PIP_FLAGS) --constraint $(OLDEST)/constraints.txt \
	    --editable '.[$(OLDEST_EXTRAS)]' setuptools
	@touch $@

$(READY): pyproject.toml
	@if [ ! -x $(PY) ]; then \
	    for candidate in $(PYTHON); do \
	        if "$$candidate" -c '$(SUITABLE)' 2>/dev/null; then found=$$candidate; break; fi; \
	    done; \
	    if [ -z "$${found:-}" ]; then \
	        echo "No Python 3.11, 3.12 or 3.13 with the venv module among: $(PYTHON). Install one" \
	            "(on Debian and Ubuntu with its python3-venv package) or name it: make PYTHON=..." >&2; \
	        exit 1; \
	    fi; \
	    echo "Creating $(VENV) with $$("$$found" --version)"; \
	    "$$found" -m venv $(VENV); \
	fi
	@echo "Installing sdc-taichi and its dependencies into $(VENV) (once, a few minutes at most)"
	@$(PY) -m pip install $(PIP_FLAGS) --editable '.[plot,fetch,dev]'
	@touch $@
