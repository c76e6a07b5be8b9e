# From a fresh clone, with Python 3.11 or later and a package index: `make demo` and `make test`.
# PYTHON names the interpreter for a new environment, VENV its folder, DIST the folder for wheels, SITE that for the documentation;
# ARGS goes to pytest, the benchmarks or the fuzzing; INPUTS and SEED to the last alone.

PYTHON ?= python3
VENV ?= .venv
DIST ?= dist
SITE ?= site
ARGS ?=
INPUTS ?= 1000000
SEED ?= 0

# Python writes bytecode whatever the user's shell says: without it, each process of the tests compiles every library again.
unexport PYTHONDONTWRITEBYTECODE

BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
PIP := $(BIN)/python -m pip --disable-pip-version-check
# uv, if it is on PATH, installs faster than pip.
UV := $(shell command -v uv 2>/dev/null)
UV_INSTALL := $(UV) pip install --python $(BIN)/python --quiet
INSTALL := $(if $(UV),$(UV_INSTALL),$(PIP) install --quiet)
# Installs into an environment without pip: uv, or the pip of the interpreter if it is recent enough (--python, 22.3).
OUTER_PIP := $(PYTHON) -m pip --disable-pip-version-check --python $(BIN)/python install --quiet --no-compile
OUTER_INSTALL := $(if $(UV),$(UV_INSTALL),$(OUTER_PIP))
OUTER_PIP_IS_RECENT := import pip, sys; sys.exit(tuple(map(int, pip.__version__.split(".")[:2])) < (22, 3))
HAS_OUTER_INSTALL := $(if $(UV),true,$(PYTHON) -c '$(OUTER_PIP_IS_RECENT)')
ROS2 := plugins/lidarspec-ros2
DISTRIBUTIONS := $(patsubst %/pyproject.toml,%,$(wildcard plugins/*/pyproject.toml))
# What needs ROS has an environment of its own.
PLUGINS := $(filter-out $(ROS2),$(DISTRIBUTIONS))
PROJECTS := pyproject.toml $(PLUGINS:%=%/pyproject.toml)
PACKAGES := lidarspec $(wildcard plugins/*/lidarspec_*)
# The editable wheels of the projects are named by path, so that nothing of the same name on an index is installed.
EDITABLES := $(VENV)/editables
CORE = $(wildcard $(EDITABLES)/lidarspec-*.whl)
USERS := $(VENV)/.installed
TESTERS := $(VENV)/.installed-test
DEVELOPERS := $(VENV)/.installed-dev
WRITERS := $(VENV)/.installed-docs
PEERS := $(VENV)/.installed-bench
ROBOTS := $(VENV)/.installed-ros2
FUZZERS := $(VENV)/.installed-fuzz
PAGE := plugins/lidarspec-web/page
MODULES := $(PAGE)/node_modules/.installed
RECENT := import sys; sys.exit(sys.version_info < (3, 11))
BUILD_TOOLS := pip 'hatchling>=1.26' 'editables>=0.5'

.PHONY: demo page page-test test test-all test-ros2 test-ros2-here test-long soak fuzz referee lint types docs wheels reference known-sensors messages bench bench-here clean

demo: $(USERS)
	@$(BIN)/lidarspec demo -s ldrobot-stl27l

# The quick tier: the engine on the shapes and ten sensors, and the golden vectors of all.
test: $(TESTERS)
	@$(BIN)/python -m pytest -n auto --dist worksteal $(ARGS)

# The quick tier, and every sensor, file format, export, page and document.
test-all: $(DEVELOPERS)
	@$(BIN)/python -m pytest -n auto --dist worksteal -m "not soak" $(ARGS)

# Build the page of `view --web` from its TypeScript with npm; commit the result.
page: $(MODULES)
	@cd $(PAGE) && npm run --silent build

# Check types and style of the page, run its unit tests, and compare the tracked files with a fresh build.
page-test: $(MODULES)
	@cd $(PAGE) && npm run --silent lint && npm test --silent && npm run --silent check

# The ROS 2 node, with ROS itself from wheels or from where it was sourced, on the loopback alone.
test-ros2:
	@$(MAKE) --no-print-directory VENV=$(VENV)-ros2 test-ros2-here

test-ros2-here: $(ROBOTS)
	@ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/python -m pytest $(ROS2) $(ARGS)

# The conformance tests with 4000 examples instead of 4: hours.
test-long: $(DEVELOPERS)
	@LIDARSPEC_EXAMPLES=4000 $(BIN)/python -m pytest -n auto -m "not soak" tests/testing/test_conformance.py $(wildcard plugins/*/tests/test_conformance.py) $(ARGS)

# Every promise and every other long test, and the table in docs/explanation/reliability.md: most of an hour.
soak: $(DEVELOPERS)
	@$(BIN)/python -m tests.soak $(ARGS)

# Hostile input for everything that reads; the same command goes on where it was stopped. 10,000,000 inputs take about two hours on two cores.
fuzz: $(FUZZERS)
	@$(BIN)/python -m tests.fuzz --inputs $(INPUTS) --seed $(SEED) $(ARGS)

# What the engine makes of fixed bytes of every sensor, compared with the record of another version: with ARGS=--record on that one.
referee: $(TESTERS)
	@$(BIN)/python -m tests.referee $(ARGS)

lint: $(TESTERS)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

types: $(DEVELOPERS)
	@$(BIN)/mypy $(PACKAGES) benchmarks

# With the pages of the sensors, the picture of the page in the browser where Chromium is, and the notebook run.
# The other pictures are tracked: docs/pictures.py remakes them, and a test fails if they are out of date.
# Without --quiet, which would let broken links pass.
docs: $(WRITERS)
	@$(BIN)/python docs/reference_pages.py
	@PATH="$(abspath $(BIN)):$$PATH" NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --site-dir $(abspath $(SITE))
	@$(BIN)/python docs/pictures.py --page --into $(SITE)/pictures

wheels: $(USERS)
	@$(BIN)/python docs/command_pages.py --man
	@$(BIN)/python .ci/build.py $(DIST) . $(DISTRIBUTIONS)

# Writes the pages of the sensors and the manual pages, which git ignores, and the generated parts of
# docs/reference/command-line.md and docs/reference/ros2.md, which are tracked.
reference: $(USERS)
	@$(BIN)/python docs/reference_pages.py
	@$(BIN)/python docs/command_pages.py

# The libraries to compare with have an environment of their own, and some of them another one within it.
bench:
	@$(MAKE) --no-print-directory VENV=$(VENV)-bench bench-here

bench-here: $(PEERS)
	@$(BIN)/python benchmarks/run.py $(ARGS)

# The table of the core that names the sensors of all distributions, from the plugins.
known-sensors: $(USERS)
	@$(BIN)/python -m tools.make_known_sensors

# Every text that a user may read, for review: errors, warnings, help texts, labels and rules.
messages:
	@$(PYTHON) tools/list_messages.py

clean:
	rm -rf $(PAGE)/node_modules $(PAGE)/dist-check $(PAGE)/dist-tests
	rm -rf .venv .venv-bench .venv-ros2 .fuzz dist site docs/man docs/reference/sensors .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find lidarspec plugins tests -name __pycache__ -type d -prune -exec rm -rf {} +

# An environment that an interrupted attempt left incomplete is completed. The pip of `python -m venv` is the last
# choice, because it takes 4 s of processor time.
$(USERS): $(PROJECTS)
	@$(BIN)/python -c 'import pip; $(RECENT)' 2>/dev/null || $(PYTHON) -c '$(RECENT)' \
		|| { echo "lidarspec needs Python 3.11 or later, and '$(PYTHON)' is not: name one, as in make PYTHON=python3.12 demo" >&2; exit 1; }
	@$(BIN)/python -c 'import pip, hatchling, editables' 2>/dev/null || { \
		echo "making the virtual environment $(VENV) with the tools that install lidarspec"; \
		if $(HAS_OUTER_INSTALL) 2>/dev/null; then \
			$(PYTHON) -m venv --without-pip $(VENV) && $(OUTER_INSTALL) $(BUILD_TOOLS); \
		else \
			$(PYTHON) -m venv $(VENV) && $(PIP) install --quiet $(BUILD_TOOLS); \
		fi; }
	@echo "building lidarspec and $(words $(PLUGINS)) plugins, editable"
	@rm -rf $(EDITABLES)
	@$(BIN)/python .ci/build.py --editable $(EDITABLES) . $(PLUGINS)
	@if [ -e $(BIN)/lidarspec ]; then $(PIP) uninstall --quiet --yes lidarspec $(notdir $(PLUGINS)); fi
	@echo "installing them and the libraries that they need into $(VENV)"
	@$(INSTALL) $(EDITABLES)/*.whl
	@touch $@

$(TESTERS): $(USERS)
	@echo "installing pytest and the small libraries that the quick tests need into $(VENV)"
	@$(INSTALL) '$(CORE)[test]'
	@echo "compiling the tests, once for all processes that run them"
	@$(BIN)/python -m pytest --collect-only -qq >/dev/null || true  # what does not compile is reported when the tests run
	@touch $@

$(DEVELOPERS): $(USERS)
	@echo "installing the libraries that all tests and the type checker need into $(VENV) (1.5 GB)"
	@$(INSTALL) '$(CORE)[dev]'
	@touch $@ $(TESTERS)

$(WRITERS): $(USERS)
	@echo "installing the libraries that build the documentation into $(VENV)"
	@$(INSTALL) '$(CORE)[docs]'
	@touch $@

$(PEERS): $(USERS) benchmarks/environments.py
	@echo "installing the libraries that lidarspec is compared with into $(VENV), once"
	@$(BIN)/python benchmarks/environments.py
	@touch $@

$(ROBOTS): $(USERS) $(ROS2)/pyproject.toml
	@echo "installing ROS 2 into $(VENV)"
	@$(INSTALL) '$(CORE)[testing]' --editable '$(ROS2)$(if $(AMENT_PREFIX_PATH),,[ros2])'
	@touch $@

$(MODULES): $(PAGE)/package-lock.json $(PAGE)/package.json
	@command -v npm >/dev/null || { echo "the page is built with npm, which is missing here: install Node.js 20 or later" >&2; exit 1; }
	@echo "installing the libraries that build the page into $(PAGE)/node_modules"
	@npm --prefix $(PAGE) ci --silent
	@touch $@

$(FUZZERS): $(DEVELOPERS)
	@$(INSTALL) 'atheris>=3.0' || echo "atheris cannot be installed here: inputs are chosen by seed" >&2
	@touch $@
