# `make demo` and `make test` set everything up by themselves: a virtual environment in .venv with the versions of
# constraints.txt, ROS 2 Jazzy included. Nothing outside this folder is touched, except that root gets python3-venv.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup demo paper docs test test-all colcon-test clean

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
OUT ?= out/demo
JOBS ?= 2
DYNSSM_DATA ?= ../shared/data
PYTHON ?= python3 python3.12 python3.11 python3.10
SUPPORTED := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))

# the environment brings its own ROS 2; a sourced one, or another environment's libraries, would shadow it
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# tests start hundreds of processes, of which each would compile the package anew
unexport PYTHONDONTWRITEBYTECODE
ifdef ROS_DISTRO
unexport PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH
endif

help: ## this list
	@echo "make TARGET, where TARGET is one of"
	@sed -nE 's/^([a-z-]+):.*## (.*)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16
	@echo "Variables: OUT=$(OUT) (folder of the demo; of paper out/paper), JOBS=$(JOBS) (processes),"
	@echo "  DYNSSM_DATA=$(DYNSSM_DATA) (measured logs and tracks), ARGS=... (of make paper: quick=1, test=NAME=R.parquet; of make test: pytest's options), PYTHON=... (interpreter, 3.10 to 3.12)"

setup: $(STAMP) ## the virtual environment alone

demo: $(STAMP) ## from simulated laps to a live prediction and its report
	@$(BIN)/python -m examples.demo --out "$(OUT)"

paper: OUT = out/paper
paper: $(STAMP) ## results.md and results_race.md of benchmarks/results measured anew, about four hours on two cores; continues after a kill
	@doit() { $(BIN)/python -m doit "$$@"; }
	doit run -n $(JOBS) -f benchmarks/dodo.py group=paper out="$(OUT)" data="$(DYNSSM_DATA)" results=benchmarks/results/results.md $(ARGS) step || true
	doit run -f benchmarks/dodo.py group=paper out="$(OUT)" data="$(DYNSSM_DATA)" results=benchmarks/results/results.md $(ARGS) document

docs: $(STAMP) ## the documentation as a site, out/site/index.html
	@$(BIN)/sphinx-build -W --keep-going -q -b html docs out/site

test: $(STAMP) ## style, types and tests, 7 to 15 minutes on two cores
test-all: $(STAMP) ## the same with the slow tests, before a release
test-all: SELECTED = -m ""

test test-all:
	@set -x
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	# the types of the newest numpy hold; Python 3.10 has an older one
	{ $(BIN)/python -c 'import sys; sys.exit(sys.version_info >= (3, 11))' || $(BIN)/mypy; } & types=$$!
	tests=0
	$(BIN)/pytest -n $(JOBS) --dist worksteal --timeout 300 $(SELECTED) $(ARGS) || tests=$$?
	wait $$types
	if [ $$tests = 0 ] && [ $@ = test-all ]; then test/colcon.sh; fi
	exit $$tests

colcon-test: $(STAMP) ## build and use the package in a fresh colcon workspace
	@test/colcon.sh

clean: ## remove what was built, the environment too
	rm -rf $(VENV) build dist install log out *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find dynssm_ros benchmarks examples test launch -name __pycache__ -prune -exec rm -rf {} +

$(STAMP): setup.py constraints.txt pyproject.toml dynssm_ros/compiled.c
	@if ! $(BIN)/python -m pip --version > /dev/null 2>&1; then
	  find_python() {
	    for candidate in $(PYTHON); do
	      if $$candidate -c '$(SUPPORTED)' 2> /dev/null; then echo $$candidate; return; fi
	    done
	  }
	  has_venv() { [ -n "$$python" ] && $$python -c 'import ensurepip, venv' 2> /dev/null; }
	  python=$$(find_python)
	  if ! has_venv && [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
	    echo "== installing python3-venv"
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq python3-venv > /dev/null
	    python=$$(find_python)
	  fi
	  if [ -z "$$python" ]; then
	    echo "error: no Python 3.10 to 3.12 among: $(PYTHON); install one, or name it: make PYTHON=/path/to/python3.12" >&2
	    exit 1
	  elif ! has_venv; then
	    echo "error: $$python has no venv module; install it first: sudo apt-get install python3-venv" >&2
	    exit 1
	  fi
	  echo "== $$($$python --version) environment in $(VENV)"
	  $$python -m venv --clear $(VENV)
	fi
	echo "== installing dynssm_ros with the versions of constraints.txt; the large parts are"
	$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off -c constraints.txt -e '.[all,docs,test]' \
	  | awk '/Downloading .*[0-9][0-9]\.[0-9] MB\)/ {print "   " $$2, $$3, $$4; fflush()}
	         /^Installing collected/ {print "== unpacking", NF - 3, "packages"; fflush()}'
	touch $@

# each recipe is one script
.ONESHELL:
