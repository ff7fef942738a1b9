# Everything lives in .venv beside this file. `make demo` installs what a running cell needs; `make test` adds the tools.
PYTHON ?= python3
TORCH ?= torch==2.13.0
BIN := .venv/bin
SOURCES := pyproject.toml setup.py $(wildcard touchcell/*/*.[ch] touchcell/*/*/*.[ch])

# Containers often set it; the suite starts some thousand interpreters, which would each compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test check fast exhaustive stress docs clean

demo: .venv/core
	$(BIN)/touchcell run configs/dual_push_sim.yaml --animate

# Tests beside emulators one after another, since they have deadlines; the others on all cores.
test: check
	TOUCHCELL_REQUIRE_COMPILED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m "not emulated and not exhaustive and not stress"
	TOUCHCELL_REQUIRE_COMPILED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/emulated -m "not exhaustive and not stress"

fast: .venv/dev
	$(BIN)/python -m pytest -m "not slow and not exhaustive and not stress"

# What `make test` takes samples of, whole: every shipped cell, page, combination of faults, version of Python.
exhaustive: .venv/dev
	TOUCHCELL_REQUIRE_COMPILED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m "exhaustive and not emulated"
	TOUCHCELL_REQUIRE_COMPILED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/emulated -m exhaustive

# Half an hour; `make stress STEPS=100000` takes a few minutes.
STEPS ?= 10000000
stress: .venv/dev
	OMP_NUM_THREADS=1 STRESS_STEPS=$(STEPS) $(BIN)/python -m pytest -vv --durations=10 -m "stress or not stress" \
		tests/perception/test_stress_*.py

# The site, into build/site; a broken link is an error.
docs: .venv/dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

check: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Metadata that a build leaves in the tree would shadow the entry points of what is installed: gone before and after.
.venv/core: $(SOURCES)
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	rm -rf *.egg-info
	$(BIN)/python -m pip install --quiet --editable .
	rm -rf *.egg-info
	touch $@

.venv/dev: .venv/core
	$(BIN)/python -m pip install --quiet "$(TORCH)"
	$(BIN)/python -m pip install --quiet --editable ".[train,dev]"
	$(BIN)/python -m pip install --quiet --editable ".[ur,franka,peers]" \
		|| echo "the vendors' clients cannot be installed here: tests that need them are skipped"
	rm -rf *.egg-info
	touch $@

clean:
	rm -rf .venv build *.egg-info touchcell/*/*.so touchcell/*/*/*.so
