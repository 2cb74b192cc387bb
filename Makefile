# Two commands: `make demo` and `make test`. Both set up .venv from the pinned constraints first. `make quick` is the part
# of `make test` for the working day. `make extras-test` installs optional packages too and runs what needs them; CI runs
# it after `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.setup-done
EXTRAS := $(VENV)/.extras-done
DEMO := demo
PIP := $(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt
# Two files of tests at a time. A test that fails alone is run without: .venv/bin/python -m pytest FILE
PYTEST := python -m pytest -q -n 2 --dist loadfile --durations=15

.PHONY: demo test quick lint types unit wheel-test sdist-test image docs extras-test table-setup lowest setup clean

demo: $(SETUP)
	$(BIN)/surgbench generate mini --out $(DEMO)/mini
	$(BIN)/surgbench run --dataset $(DEMO)/mini --suite demo --out $(DEMO)/runs
	$(BIN)/surgbench report $(DEMO)/runs --format markdown --out $(DEMO)/leaderboard.md
	$(BIN)/surgbench video $(DEMO)/runs --frames 4 --samples --out $(DEMO)/pictures
	$(BIN)/surgbench generate wire-chaser-mini --out $(DEMO)/chaser
	$(BIN)/surgbench run --dataset $(DEMO)/chaser --tracker gaze --tracker autocam --out $(DEMO)/chaser-runs
	$(BIN)/surgbench report $(DEMO)/runs $(DEMO)/chaser-runs --format html --out $(DEMO)/report.html
	@echo "overlay picture: $(DEMO)/pictures/000-left.png   table: $(DEMO)/leaderboard.md"
	@echo "all of it, to be opened in a browser: $(DEMO)/report.html"

test: lint types unit wheel-test

# For the working day: within a minute, something of every area. What is slow is marked so where it stands.
quick: lint types
	$(BIN)/$(PYTEST) -m "not slow"

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/hadolint Dockerfile

types: $(SETUP)
	$(BIN)/mypy

unit: $(SETUP)
	$(BIN)/$(PYTEST) -m "not long"

# The only check that the wheel holds every file and works from another folder. What the code does, `unit` has said.
WHEEL_TESTS := test_packaging test_installed
wheel-test: $(SETUP)
	rm -rf build/wheel-test build/lib build/bdist.* && mkdir -p build/wheel-test/elsewhere
	$(BIN)/python -m build -q --wheel --no-isolation --outdir build/wheel-test .
	$(BIN)/python -m pip install --disable-pip-version-check -q --no-deps --target build/wheel-test/site build/wheel-test/*.whl
	cd build/wheel-test/elsewhere && PYTHONPATH=../site SURGBENCH_EXPECT_SITE="$(CURDIR)/build/wheel-test/site" \
		../../../$(BIN)/$(PYTEST) -c ../../../pyproject.toml --rootdir ../../.. \
		$(WHEEL_TESTS:%=../../../tests/engine/%.py)

# What is uploaded: `build` makes the source distribution, and the wheel of that, not of this folder. The wheel's tests
# then run as they lie in the unpacked source distribution.
SDIST_TEST := build/sdist-test
sdist-test: $(SETUP)
	rm -rf $(SDIST_TEST) build/lib build/bdist.* && mkdir -p $(SDIST_TEST)/elsewhere $(SDIST_TEST)/source
	$(BIN)/python -m build -q --no-isolation --outdir $(SDIST_TEST) .
	$(BIN)/twine check --strict $(SDIST_TEST)/*.tar.gz $(SDIST_TEST)/*.whl
	tar -xzf $(SDIST_TEST)/*.tar.gz -C $(SDIST_TEST)/source --strip-components 1
	$(BIN)/python -m pip install --disable-pip-version-check -q --no-deps --target $(SDIST_TEST)/site $(SDIST_TEST)/*.whl
	cd $(SDIST_TEST)/elsewhere && PYTHONPATH=../site SURGBENCH_EXPECT_SITE="$(CURDIR)/$(SDIST_TEST)/site" \
		../../../$(BIN)/$(PYTEST) -c ../source/pyproject.toml --rootdir ../source \
		$(WHEEL_TESTS:%=../source/tests/engine/%.py)

# Where there is Docker. The address of PyTorch's CPU build is that of the environment, as it is pip's.
image: $(SETUP)
	$(BIN)/hadolint Dockerfile
	@if docker info >/dev/null 2>&1; then \
		docker build --tag surgbench --build-arg PIP_EXTRA_INDEX_URL . && docker run --rm surgbench --version; \
	else echo "no Docker answers: the Dockerfile is linted only"; fi

# Only what is skipped without the extras, and what takes longest. Types are not checked again: pyproject.toml has mypy pass over what the extras
# install, so that its verdict is the same.
extras-test: $(EXTRAS)
	$(BIN)/$(PYTEST) -m "extras or long"

# What `surgbench reproduce table1` runs besides: TuRBO, figures, and an LLVM for Mitsuba's gradient. Without the last one
# row is skipped, which the first line of its output says.
table-setup: $(EXTRAS)
	apt-get install -y libllvm19 || echo "no libllvm19: install an LLVM of 17 or later, or set DRJIT_LIBLLVM_PATH"

# The documentation as a site, in site/. A broken link or anchor fails it.
docs: $(EXTRAS)
	$(BIN)/mkdocs build --strict

# The lowest declared versions, and every Python that is found; takes long, and is no part of CI.
lowest: $(SETUP)
	$(BIN)/python tools/lowest.py

setup: $(SETUP)

$(SETUP): pyproject.toml constraints.txt tools/system-libraries.sh
	sh tools/system-libraries.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	PYTHONWARNINGS=ignore $(PIP) -e '.[dev]'
	touch $@

$(EXTRAS): $(SETUP)
	sh tools/system-libraries.sh meshes browser
	PYTHONWARNINGS=ignore $(PIP) -e '.[dev,turbo,meshes,plots,onnx,video,readers,browser,sam2,control,bags,gym,cluster,view,notebooks,docs]'
	touch $@

clean:
	rm -rf build site $(DEMO)
