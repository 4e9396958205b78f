# Every command works in a fresh clone: what it needs is set up first.
# Another Python: make test PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
HEADLESS := sh scripts/headless.sh
PLUGINS := -p hypothesispytest -p napari -p pytest-qt -p timeout -p xdist
# How many random problems `make trust` solves on each, and which.
LOOPS ?= 5000
SHADERS ?= 500
VOLUMES ?= 600
SEED ?= 0
# How many random problems `make cavities` solves.
PROBLEMS ?= 2500
CAMPAIGN = OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(RUN) -m benchmarks.campaign --seed $(SEED)

.DEFAULT_GOAL := help
# A target is a command, also where a folder has its name.
.PHONY: help $(MAKECMDGOALS)

help:
	@echo "make demo         deform the sample brain; pictures in demo-output/, napari where there is a display"
	@echo "make test         run the tests"
	@echo "make format       format the code"
	@echo "make lint types   look for mistakes in style, imports and dependencies, and in types"
	@echo "make structure    print sizes, compiled loops, models and caches; check which module imports which"
	@echo "make docs         build the site of the documentation: docs/_build/index.html"
	@echo "make campaigns    run the long tests: further cases, examples, notebooks, code in the documentation"
	@echo "make wheel        build the wheel, and try it with the oldest and the newest napari that it allows"
	@echo "make mutations    break the package in many places, one by one, and see a test fail: NAMES=solver"
	@echo "make speed        time and memory of this package: NAMES='solve drag', AGAINST=folder compares checkouts"
	@echo "make peers        time this package beside PyAMG, SuperLU and CalculiX: NAMES=peers.volumes"
	@echo "make report       measure the tables of the validation report again: ten minutes"
	@echo "make screenshots  draw the pictures of the documentation again: NAMES=tutorials"
	@echo "make sample-data  make the files of sample_data/ again"
	@echo "make constraints  take the newest versions of everything, and write down which"
	@echo "make clean        delete what the commands above made, the environment included"
	@echo "docs/development/measure.md lists the other commands, which measure speed and accuracy."

setup:
	@$(PYTHON) scripts/setup.py

setup-for-windows:
	@$(PYTHON) scripts/setup.py --for-windows

setup-for-report:
	@$(PYTHON) scripts/setup.py --for-report

demo: setup
	@$(VENV)/bin/napari-hmrf demo

# A third process would take longer to start than two cores wait.
# The plugins are named: of those that pytest finds by itself it rewrites all modules, and all of
# napari is one.
test: setup-for-windows
	@PYTHONDONTWRITEBYTECODE= PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(HEADLESS) $(RUN) -m pytest $(PLUGINS) -n 2 --dist worksteal

campaigns: setup-for-windows
	@CI= $(HEADLESS) $(RUN) -m pytest -m campaign

wheel: setup-for-windows
	@$(HEADLESS) $(RUN) scripts/wheel.py

# Warnings are errors, and all of them are shown. Nothing is fetched.
docs: setup
	@$(RUN) -m sphinx -W --keep-going -E -q docs docs/_build
	@echo "The site is in docs/_build: open docs/_build/index.html"

format: setup
	@$(RUN) -m ruff format .
	@$(RUN) -m ruff check --fix .

# The last line finds personal paths; the brackets keep it from finding itself.
lint: setup
	@$(RUN) -m ruff format --check .
	@$(RUN) -m ruff check .
	@$(VENV)/bin/lint-imports --no-logo --no-cache
	@$(RUN) -m deptry napari_hmrf
	@! git grep -nE '/[h]ome/\w|/[U]sers/\w|/[r]oot\b|[A-Z]:\\[U]sers|/[w]ork/\w|/[t]mp/\w'

structure: setup
	@$(VENV)/bin/lint-imports --no-logo --no-cache
	@$(RUN) scripts/structure.py

types: setup
	@$(RUN) -m mypy

speed: setup
	@$(RUN) -m benchmarks.speed $(NAMES) $(if $(AGAINST),--against $(AGAINST))

window: setup-for-windows
	@$(HEADLESS) $(RUN) -m benchmarks.window $(if $(AGAINST),--against $(AGAINST))

first-use: setup-for-windows
	@$(HEADLESS) $(RUN) -m benchmarks.first_use $(if $(AGAINST),--against $(AGAINST))

routes: setup-for-windows
	@$(HEADLESS) $(RUN) -m benchmarks.routes

peers: NAMES = peers
peers: setup-for-report
	@$(RUN) -m validation $(NAMES)

paper: setup
	@$(RUN) -m validation paper.table-1 paper.table-2

trust: setup
	@$(CAMPAIGN) images=$(LOOPS) volumes=$(VOLUMES)
	@$(CAMPAIGN) images=$(SHADERS) --backend opengl

cavities: setup
	@$(CAMPAIGN) parts=$(PROBLEMS)

uncertainty: setup
	@$(RUN) -m validation uncertainty

edits: setup
	@$(CAMPAIGN) edits

folds: setup
	@$(CAMPAIGN) large-motion large-volumes

soak: setup
	@$(CAMPAIGN) memory

damaged: setup
	@$(RUN) -m validation damaged --seeds $(SEED)

disks: setup
	@$(RUN) -m validation robustness --write

volumes: setup
	@$(CAMPAIGN) volumes

roofline: setup
	@$(RUN) -m validation hardware.roofline

report: setup-for-report
	@$(RUN) -m validation report --write

hard: setup-for-report
	@$(RUN) -m validation hard --results benchmark-output/hard.jsonl --write

mutations: setup-for-windows
	@$(HEADLESS) $(RUN) scripts/mutations.py $(NAMES)

screenshots: setup-for-windows
	@$(HEADLESS) $(RUN) scripts/screenshots.py $(NAMES)

sample-data: setup
	@$(RUN) scripts/make_sample_data.py

constraints:
	@$(PYTHON) scripts/setup.py --newest

clean:
	rm -rf $(VENV) build dist docs/_build demo-output benchmark-output .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
