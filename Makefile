# Set-up and checks. On a bare machine with Python >= 3.11, make and git:
#   make demo    make the environment, make a synthetic dataset, measure it, compare with the truth
#   make quick   tests of geometry, statistics, formats, protocols and designs
#   make test    lint, types, layer contracts and tests, exactly as in CI
#   make separable    tests and demonstration without each extension
#   make release    what takes long: validation, tutorials, questions, faults, containers, clusters, browser
#   make validation    measure accuracy: all suites, and their tables in docs/validation
#   make docs    the documentation as a site in build/site, without network

VENV ?= .venv
DEMO ?= demo

# The first interpreter that really runs, is new enough and can make environments: a name on the
# PATH is no proof, since version managers put launchers there that fail when called.
USABLE := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for python in python3.13 python3.12 python3.11 python3; do \
	"$$python" -c '$(USABLE)' >/dev/null 2>&1 && echo "$$python" && break; done)

# Bytecode is kept whatever the surroundings say: each of the processes that tests start would
# compile all packages again.
export PYTHONDONTWRITEBYTECODE :=

BIN := $(VENV)/bin
# Changes to either file mean that the environment is out of date.
STAMP := $(VENV)/.made-from-lock

.PHONY: help env demo quick test brief separable release lint types layers unit validation docs format lock clean
help:
	@sed -n '2,/^$$/s/^# \{0,1\}//p' Makefile

env: $(STAMP)

$(STAMP): requirements-dev.lock pyproject.toml
	@"$(BIN)/python" -c '$(USABLE)' >/dev/null 2>&1 || "$(PYTHON)" -c '$(USABLE)' >/dev/null 2>&1 \
	|| { echo "hipsta_bids needs Python 3.11 or newer with its venv module (on Debian and Ubuntu:\
	 the package python3-venv). None was found; name one with:\
	 make PYTHON=/path/to/python3 ..." >&2; exit 1; }
	@echo "Making the environment in $(VENV) from requirements-dev.lock (some minutes at first)"
	@"$(BIN)/python" -c '$(USABLE)' >/dev/null 2>&1 || "$(PYTHON)" -m venv --clear "$(VENV)"
	"$(BIN)/python" -m pip install -qq --disable-pip-version-check --require-hashes --no-deps \
		--no-compile -r requirements-dev.lock
	"$(BIN)/python" -m pip install -qq --disable-pip-version-check --no-deps \
		--no-build-isolation -e .
	@touch "$@"

demo: $(STAMP)
	"$(BIN)/hipsta-bids" demo "$(DEMO)"

test: lint types layers unit brief

# Two extensions are deleted, others each day.
brief: $(STAMP)
	PYTHON="$(BIN)/python" tools/test-separable --brief

lint: $(STAMP)
	"$(BIN)/python" -m ruff check .
	"$(BIN)/python" -m ruff format --check .
	"$(BIN)/codespell"
	"$(BIN)/python" tools/names.py
	"$(BIN)/python" tools/functions.py
	"$(BIN)/python" tools/words.py

types: $(STAMP)
	MYPYPATH=tools:benchmarks "$(BIN)/python" -m mypy --strict --scripts-are-modules \
		hipsta_bids validation tools/*.py tools/make-descriptors tools/make-docs benchmarks/*.py

layers: $(STAMP)
	"$(BIN)/lint-imports" --no-cache

# A thread each: the two processes would wait for each other's.
THREADS = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
PYTEST = $(THREADS) "$(BIN)/python" -m pytest -n 2 --dist loadfile
QUICK = geometry io protocols stats
# The wheel as users get it, tested from a folder that is not the checkout.
INSTALLED := $(VENV)/installed
unit: $(STAMP)
	tools/install-wheel "$(BIN)/python" "$(INSTALLED)"
	cd "$(INSTALLED)/away" && $(THREADS) HIPSTA_BIDS_INSTALLED=required ../bin/python -m pytest \
		-n 2 --dist loadfile -c "$(CURDIR)/pyproject.toml" --rootdir "$(CURDIR)" \
		-o "pythonpath=tools benchmarks" "$(CURDIR)/tests"

quick: $(STAMP)
	$(PYTEST) -m "not slow" $(QUICK:%=tests/%)

separable: $(STAMP)
	PYTHON="$(BIN)/python" tools/test-separable

release: $(STAMP) validation separable
	set -e; for script in tutorials questions disclosure faults fuzz container cluster reports long install; do \
		PYTHON="$(BIN)/python" "tools/test-$$script"; done

# All suites, on the real labels too where they are: LABELS=BIDS_DIR.
validation: $(STAMP)
	"$(BIN)/python" -m validation --full --out docs/validation $(if $(LABELS),--labels "$(LABELS)")

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 "$(BIN)/python" -m mkdocs build --strict --quiet
	@echo "build/site/index.html"

format: $(STAMP)
	"$(BIN)/python" -m ruff format .
	"$(BIN)/python" -m ruff check --fix .

# The locks hold every version and hash, for Python 3.11 and later on Linux and macOS. The second
# repeats the first, which is what is in the image, and adds the tools for development.
COMPILE = "$(BIN)/python" -m uv pip compile pyproject.toml --quiet --universal \
	--python-version 3.11 --fork-strategy fewest --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock" $(LOCK_FLAGS)
lock: $(STAMP)
	"$(BIN)/python" -m pip install -qq --disable-pip-version-check "uv>=0.8"
	$(COMPILE) --extra cluster --extra transforms --output-file requirements.lock
	$(COMPILE) --extra dev --extra docs --constraints requirements.lock --output-file requirements-dev.lock

clean:
	rm -rf demo build .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
