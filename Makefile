# Two commands: `make demo` and `make test`. Both set up .venv from the pinned constraints first. `make extras-test`
# installs optional packages too and runs what needs them; CI runs it after `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.setup-done
EXTRAS := $(VENV)/.extras-done
DEMO := demo
PIP := $(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt
# Two files of tests at a time. A test that fails alone is run without: .venv/bin/python -m pytest FILE
PYTEST := python -m pytest -q -n 2 --dist loadfile

.PHONY: demo test lint types unit wheel-test extras-test setup clean

demo: $(SETUP)
	$(BIN)/surgbench generate mini --out $(DEMO)/mini
	$(BIN)/surgbench run --dataset $(DEMO)/mini --suite demo --out $(DEMO)/runs
	$(BIN)/surgbench report $(DEMO)/runs --format markdown --out $(DEMO)/leaderboard.md
	$(BIN)/surgbench video $(DEMO)/runs --frames 4 --samples --out $(DEMO)/pictures
	$(BIN)/surgbench generate wire-chaser-mini --out $(DEMO)/chaser
	$(BIN)/surgbench run --dataset $(DEMO)/chaser --tracker gaze --tracker autocam --out $(DEMO)/chaser-runs
	@echo "overlay picture: $(DEMO)/pictures/000-left.png   table: $(DEMO)/leaderboard.md"

test: lint types unit wheel-test

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(SETUP)
	$(BIN)/mypy

unit: $(SETUP)
	$(BIN)/$(PYTEST)

# The only check that the wheel holds every file: install it elsewhere and run tests from another folder, those that
# use each kind of packaged file (the others would say the same twice).
WHEEL_TESTS := engine/test_packaging engine/test_cli engine/test_registry instrument/test_instrument trackers/test_trackers engine/test_bench engine/test_report exchange/test_import instrument/test_video
wheel-test: $(SETUP)
	rm -rf build && mkdir -p build/wheel-test/elsewhere
	$(BIN)/python -m build -q --wheel --no-isolation --outdir build/wheel-test .
	$(BIN)/python -m pip install --disable-pip-version-check -q --no-deps --target build/wheel-test/site build/wheel-test/*.whl
	cd build/wheel-test/elsewhere && PYTHONPATH=../site SURGBENCH_EXPECT_SITE="$(CURDIR)/build/wheel-test/site" \
		../../../$(BIN)/$(PYTEST) -c ../../../pyproject.toml --rootdir ../../.. \
		$(WHEEL_TESTS:%=../../../tests/%.py) \
		../../../tests/engine/test_run.py::test_the_papers_tracker_follows_the_mini_dataset

# Types are checked once more, for with the extras there is more to check against.
EXTRAS_TESTS := instrument/test_instrument engine/test_reproduce trackers/test_turbo viewpoint/test_viewpoint_run
extras-test: $(EXTRAS)
	$(BIN)/mypy
	$(BIN)/$(PYTEST) $(EXTRAS_TESTS:%=tests/%.py)

setup: $(SETUP)

$(SETUP): pyproject.toml constraints.txt tools/system-libraries.sh
	sh tools/system-libraries.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	PYTHONWARNINGS=ignore $(PIP) -e '.[dev]'
	touch $@

$(EXTRAS): $(SETUP)
	sh tools/system-libraries.sh meshes
	PYTHONWARNINGS=ignore $(PIP) -e '.[dev,turbo,meshes,plots]'
	touch $@

clean:
	rm -rf build $(DEMO)
