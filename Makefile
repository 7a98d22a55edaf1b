# One virtual environment for everything; each part of it is installed once, and again when its pins change.
PYTHON ?= python3
VENV := .venv
# Empty for the newest versions of all dependencies.
CONSTRAINTS := constraints.txt
SCRIPTS := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
BIN := $(VENV)/$(SCRIPTS)
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check $(if $(CONSTRAINTS),--constraint $(CONSTRAINTS))
DEMO_SECONDS := 45
# Those left out need what nobody can make for them: another checkout, a real image, runs, a folder to keep; fuzz_guided
# ends by itself never.
BENCHMARKS := $(filter-out $(patsubst %,benchmarks/%.py,scenes fuzz_guided equal_steps unmixing_2d confidence found_poses), \
  $(sort $(wildcard benchmarks/[a-z]*.py)))

MINIMUM := .venv-minimum
MINIMUM_TESTS := tests/engine tests/spectral tests/editing tests/formats tests/scenes tests/figures tests/viewer/test_server.py tests/captures/readers

.PHONY: coverage results-check results-table scenes demo test cases test-random test-all test-minimum test-portable wheel platforms audit lint format bench notebooks site clean help

help:
	@echo "make demo    train on the built-in scene, evaluate, export abundance maps and a page to share"
	@echo "make test    run the tests, less the slow ones"
	@echo "make coverage   run the same tests, and say which lines of the package they reach"
	@echo "make cases   run those of the tests that read files as other people's programs write them"
	@echo "make test-random   run the property tests on cases that are drawn anew"
	@echo "make test-all   run every test, and check each shape annotation while they run"
	@echo "make test-minimum   run the core of the tests on the lowest versions that are allowed"
	@echo "make test-portable   run the tests, less the slow ones, with what only POSIX has taken away"
	@echo "make wheel   build sdist and wheel into dist, and use the wheel without the repository"
	@echo "make platforms   look whether every dependency has wheels on every system (needs the network)"
	@echo "make audit   look for known holes in what is pinned (needs the network)"
	@echo "make lint    check format, lint rules, types and the import law"
	@echo "make format  rewrite the code in the one format"
	@echo "make scenes  render the scenes that benchmarks train on, into a cache"
	@echo "make bench   make the scenes that are missing, run every benchmark, results into benchmarks/results"
	@echo "make results-table   measure README's table of results again (an hour)"
	@echo "make results-check   say which results that docs cite have to be measured again"
	@echo "make site    build the site from docs/ into build/site/html, and check its links"
	@echo "make notebooks   run the tutorials"
	@echo "make clean   remove the virtual environment and caches"

$(BIN)/python:
	@$(PYTHON) -c "import sys; sys.exit(None if sys.version_info >= (3, 10) else 'Python 3.10 or newer is needed; name one as in: make PYTHON=python3.12')"
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing unmix-nerf into $(VENV) (once) ..."
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "installing the development tools into $(VENV) (once) ..."
	$(INSTALL) --editable '.[dev,tensorboard]'
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/unmix-demo --seconds $(DEMO_SECONDS)

# A browser, which only slow tests use, where it can be had; tried once.
$(VENV)/.system-packages: scripts/install_system_packages.sh | $(BIN)/python
	@scripts/install_system_packages.sh
	@touch $@

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses 2 -m "not slow"

# As `make test`, and how many lines of the package the tests reach; kernels, which run elsewhere, count as not reached.
coverage: $(VENV)/.installed-dev
	$(INSTALL) pytest-cov
	$(BIN)/python -m pytest --numprocesses 2 -m "not slow" --cov unmix_plugin --cov-report term:skip-covered

# A part of `make test`, in less than a minute.
cases: $(VENV)/.installed-dev
	$(BIN)/python -m pytest tests/cases

# Elsewhere property tests draw the same cases each time. A failure prints its case: make it a test.
test-random: $(VENV)/.installed-dev
	UNMIX_RANDOM_CASES=1 $(BIN)/python -m pytest --numprocesses 2 -m "hypothesis and not slow"

test-all: $(VENV)/.installed-dev $(VENV)/.system-packages
	$(BIN)/python -m pytest --numprocesses 2 --jaxtyping-packages=unmix_plugin,beartype.beartype

# As on Windows: without the modules, functions and signals that only POSIX has, and with a narrow console.
test-portable: $(VENV)/.installed-dev
	PYTHONPATH=scripts/without_posix $(BIN)/python -m pytest --numprocesses 2 -m "not slow"

# Deprecations that old releases warn of are no failures here, and old checkers of shapes are left out.
test-minimum:
	$(PYTHON) -m venv $(MINIMUM)
	$(MINIMUM)/$(SCRIPTS)/python -m pip install --quiet --disable-pip-version-check --constraint constraints-minimum.txt \
	  --editable '.[captures]' hypothesis imageio plyfile pytest spectral trimesh
	$(MINIMUM)/$(SCRIPTS)/python -m pytest -W default --override-ini addopts=--import-mode=importlib $(MINIMUM_TESTS)

# What they need comes as wheels, so that no compiler is needed; spectral, of the tests, is plain Python.
platforms: | $(BIN)/python
	$(INSTALL) uv
	@set -e; for system in linux macos windows; do for python in 3.10 3.14; do \
	  echo "wheels for Python $$python on $$system"; \
	  MACOSX_DEPLOYMENT_TARGET=14.0 $(BIN)/uv pip compile --quiet --only-binary :all: --python-platform $$system \
	    --python-version $$python --constraint constraints.txt --extra captures --extra sfm --extra las --extra lmrm \
	    --extra reference --extra tensorboard --extra docs --output-file /dev/null pyproject.toml; done; done

wheel: | $(BIN)/python
	$(INSTALL) build twine
	$(BIN)/python scripts/check_wheel.py $(WHEEL_OPTIONS)

# Strict: what could not be looked up has not been audited.
audit: | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(BIN)/python -m pip_audit --strict --no-deps --disable-pip --requirement constraints.txt

lint: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports --no-logo

format: $(VENV)/.installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Scenes are made once, in about half an hour of two cores, into a cache; what is there is kept.
scenes: $(VENV)/.installed-dev
	$(INSTALL) --editable '.[reference]'
	$(BIN)/python benchmarks/scenes.py

bench: scenes
	@failed=; for benchmark in $(BENCHMARKS); do echo "== $$benchmark"; \
	  $(BIN)/python $$benchmark || failed="$$failed $$benchmark"; done; \
	  if [ -n "$$failed" ]; then echo "without a result:$$failed"; exit 1; fi

# The table of README: measured again where QUALITY is a time or steps, which takes an hour of two cores.
results-table: scenes
	$(BIN)/python benchmarks/quality.py $(QUALITY)
	$(BIN)/python scripts/results_table.py

# Apart from the tests, since it needs the history: which results that docs cite are dirty, unknown, or old.
results-check: | $(BIN)/python
	$(BIN)/python scripts/check_results.py

notebooks: $(VENV)/.installed-dev
	$(BIN)/python scripts/run_notebooks.py

site: $(VENV)/.installed-dev
	PYTHON=$(BIN)/python scripts/build_site.sh

clean:
	rm -rf $(VENV) $(MINIMUM) build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
