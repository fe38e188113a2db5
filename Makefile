# Every target works on a fresh clone: it first installs what it needs, once. `make help` lists the targets.

.DEFAULT_GOAL := help
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:

# Overridable: make train EXP=transfer_ph32_exec16 ARGS="seed=1"
PYTHON ?= python3
EXP ?= socket_ph32_exec16
TASK ?= socket
EPISODES ?= 4
ARGS ?=
HASHES ?=

SHIPPED_socket := socket_ph32_exec16/demos.episodes=800,seed=0
SHIPPED_dwell := transfer_dwell/seed=0
SHIPPED := experiments/pretrained/$(or $(SHIPPED_$(TASK)),$(TASK)_ph32_exec16/default)
VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --quiet --disable-pip-version-check
BUILD := $(PIP) install --no-deps --no-build-isolation
INSTALLED := $(VENV)/.installed

.PHONY: help setup train demos eval sweep-socket sweep-transfer sweep-horizon sweep-evaluations sweep-demonstrations sweep-dwell sweep-clock sweep-conditions campaign bench tables report gallery wheel test lint clean

help:  ## List the targets
	@awk 'BEGIN {FS = ":.*## "; print "make <target> [NAME=value ...]\n"} \
	     /^[a-z-]+:.*## / {printf "  %-21s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))
	@printf '\n  ARGS="..." is passed to the command; PYTHON=python3.12 sets the interpreter of $(VENV), HASHES=1 checks what is installed.\n'

setup: $(INSTALLED)  ## Install into .venv, install a GL library if none renders, check the machine
	@$(PY) tools/doctor.py --only gl > /dev/null || { [ $$? != 2 ] && tools/install_gl.sh $(PY); }
	@$(PY) tools/doctor.py

train: setup  ## Main job: demonstrations, training, 100 rollouts, the table's row (EXP=socket_ph32_exec16)
	$(PY) -m imfvla.train +exp=$(EXP) $(ARGS)

demos: setup  ## Record the demonstrations of both tasks (ARGS="episodes=200")
	$(PY) -m imfvla.collect task=socket $(ARGS)
	$(PY) -m imfvla.collect task=transfer $(ARGS)

eval: setup  ## Roll out the shipped policy, write a video (TASK=socket, transfer or dwell, EPISODES=4)
	$(PY) -m imfvla.evaluate run=$(SHIPPED) episodes=$(EPISODES) nfe=1 $(ARGS)
	@echo "Videos, and MCAP files for Foxglove beside them:"; ls $(SHIPPED)/rollouts/*/*.mp4

# Rerun a stopped sweep to resume it: finished jobs are skipped, failed ones are listed.
sweep-socket:  ## Train and evaluate every row of Table 1 (ARGS="seed=0,1,2")
sweep-transfer:  ## Train and evaluate every row of Table 2
sweep-horizon:  ## Vary predicted and executed steps
sweep-evaluations:  ## Evaluate with 1 to 10 steps per chunk
sweep-dwell:  ## Train and evaluate every method on the task where averages fail
sweep-demonstrations:  ## Train on 25 to 200 demonstrations
sweep-clock:  ## Evaluate object transfer while the clock runs (Table 4)
sweep-conditions:  ## Evaluate object transfer in a changed world (Table 5)
sweep-socket sweep-transfer sweep-horizon sweep-evaluations sweep-demonstrations sweep-dwell sweep-clock sweep-conditions: sweep-%: setup
	$(PY) -m imfvla.train -m +sweep=$* $(ARGS)

campaign: setup  ## Train, evaluate and keep every policy of Tables 1 and 2 and the controls (ARGS="--side-by-side 2")
	$(PY) tools/campaign.py $(ARGS)

bench: setup  ## Measure sizes, simulation, rendering, training and latency on this machine
	$(PY) -m imfvla.bench $(ARGS)

tables: setup  ## Make the paper's tables and figures and a page from the run directories
	OMP_NUM_THREADS=1 $(PY) -m imfvla.report $(ARGS)

report: setup  ## Make them in experiments/report, with videos and recordings: a folder to send or serve
	OMP_NUM_THREADS=1 $(PY) -m imfvla.report output=experiments/report media=true $(ARGS)

gallery: setup  ## Write pictures of every view of the tasks, and of every condition of an evaluation
	for task in socket transfer either_arm gate; do $(PY) -m imfvla.gallery task=$$task $(ARGS); done
	for task in socket transfer; do $(PY) -m imfvla.gallery task=$$task of=conditions size=140; done

wheel: $(INSTALLED)  ## Build dist/imfvla-*.whl, which works from any directory
	rm -rf build dist
	$(PIP) wheel --no-build-isolation --no-deps -w dist .
	rm -rf build

test: setup  ## Run the tests on two processes (ARGS="tests/tasks -k seed")
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 $(ARGS)

lint: $(INSTALLED)  ## Check style and format with ruff
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

clean:  ## Remove .venv and caches; runs/ and data/ stay
	rm -rf $(VENV) .pytest_cache .ruff_cache *.egg-info build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml setup.py constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "imfvla needs Python 3.11 or newer, found $$($(PYTHON) --version 2>&1); name one: make setup PYTHON=python3.11" >&2; \
	  exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	  echo "$(PYTHON) could not create a virtual environment; on Debian: sudo apt-get install python3-venv" >&2; \
	  exit 1; }
ifdef HASHES  # only files that hashes.txt knows; setuptools first, since some packages are built
	@sed -n '/^setuptools==/,/[^\\]$$/p' hashes.txt > $(VENV)/setuptools.txt
	@$(PIP) install --require-hashes -r $(VENV)/setuptools.txt
	@if $(PY) -c 'import sys; sys.exit(sys.version_info < (3, 13))'; then $(BUILD) ./tools/labmaze; fi
	$(BUILD) --use-pep517 --require-hashes -r hashes.txt
	@if $(PY) -c 'from importlib.metadata import requires; exit("cuda" not in str(requires("torch")))'; then \
	  $(BUILD) --require-hashes -r hashes-cuda.txt; fi
	$(BUILD) -e .
else
	@if $(PY) -c 'import sys; sys.exit(sys.version_info < (3, 13))'; then $(PIP) install ./tools/labmaze; fi
	$(PIP) install -c constraints.txt -e '.[dev]'
	$(PIP) install -c constraints.txt --no-deps gym-pusht # which asks for another OpenCV than ours
endif
	@touch $@
