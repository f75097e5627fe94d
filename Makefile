# Two commands do everything on a fresh machine: make demo, make test. A third, make data, fetches real data.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: demo test slow data lint bench clean
.DEFAULT_GOAL := demo

$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "apmodels needs Python 3.11 or newer: make $(MAKECMDGOALS) PYTHON=python3.11" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "torch>=2.4,<2.14"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

# The main job: find the face in a real photograph.
demo: $(STAMP)
	$(BIN)/apmodels experiment=find_face hydra.run.dir=outputs/demo
	@echo "The picture is outputs/demo/find_face.png"

.venv/.tested: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	touch $@

# A test a core, and a thread a test: more of them would only wait for each other.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 8

test: .venv/.tested lint
	$(PYTEST)
	$(BIN)/python -m pytest --nbmake notebooks

slow: .venv/.tested
	$(PYTEST) -m slow

lint: .venv/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# Ratios to peers, which are installed for it and for nothing else.
.venv/.benched: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[bench]"
	touch $@

bench: .venv/.benched
	$(BIN)/python -m benchmarks

data: $(STAMP)
	$(BIN)/python -m experiments.data

clean:
	rm -rf .venv outputs multirun
