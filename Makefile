# make setup   .venv and install/, from pinned wheels; quick when nothing changed
# make demo    set-up, then a simulated plant, the monitor, an alarm and a recording
# make demo-opcua   set-up, then a plant behind an OPC UA server, gateway and monitor: a lost link, the way back
# make test    set-up, then every test on all cores (PYTEST_ARGS='-k partition' for some, PARALLEL= for one by one)
# make test-versions   every test with Python 3.12 and the libraries of Ubuntu 24.04, and with Python 3.10
#                 and the newest, each in a copy under build/ (PYTHONS='python3.10 /path/to/python3.12')
# make test-slow   set-up, then the tests marked slow, and those with drawn examples on fresh ones
# make lint    set-up, then ruff and mypy           (make format rewrites the layout)
# make bench   set-up, then what is fast, measured
# make bench-gate  set-up, then this tree's speed against an earlier one's, by ratios (BASE=COMMIT; minutes)
# make mutation   set-up, then small mistakes in recorder, recovery and state: which do the tests
#                 notice? (hours; ONLY='valveflow_ros.state*' for some)
# make repeat   set-up, then the quick tests of recorder, recovery and state, N=200 times, each time in
#                 another order of the files, to find one that wavers
# make torture   set-up, then kills, faults, flips, fuzz, signals and a year of soak, counted (hours)
# make study   how good curve, intervals, alarms, baselines and the judgement of loops are (hours)
# make study-diagnosis   how often the diagnosis names the right cause, and none where there is none (hours)
# make certify-partition   the exact partition of 305,633 samples against every break (minutes)
# make docs    set-up, then the site: site/html, made by mkdocs in .venv-docs (Python 3.11 or later)
# make lock    requirements.in -> requirements.lock (UPGRADE=1 takes newer versions)
# make clean   remove everything the set-up made
#
# PYTHON=/path/to/python3.12 chooses the Python; CC and CXX choose the compilers.

SHELL := bash
.DEFAULT_GOAL := help
.PHONY: help setup demo demo-opcua test test-versions test-slow lint format bench bench-gate mutation repeat torture study study-diagnosis certify-partition docs lock clean

export PYTHON
# The matrices are small: on a busy machine more threads of OpenBLAS only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1
ENV := source ./env.sh &&
VALVEFLOW_DEMO ?= bash -c 'source env.sh && python -m valveflow_ros.ros.demo --output demo_output'
PYTEST_ARGS ?=
# A file's tests stay together, for they share what is dear to make; the long files come first.
# Many tests wait for other processes, so there are more workers than cores.
WORKERS := $(shell cores=$$(nproc); echo $$((cores + cores / 2)))
PARALLEL ?= -n $(WORKERS) --maxprocesses 4 --dist loadfile --no-loadscope-reorder
PYTHONS ?= python3.10 python3.12
# Checked as strictly as mypy can; ros/ is not, because rclpy carries no annotations.
STRICT := $(wildcard $(addprefix valveflow_ros/,*.py signals segments partition curve fit \
  monitoring diagnosis baselines plant logs opcua report interface page cli) tools)
BENCHMARKS := node_load partition reading ten_days
STUDIES := paper_study coverage_study monitor_study compare_study refinery_valves

help:
	@sed -n 's/^# //p;/^$$/q' Makefile

setup:
	@sh tools/setup.sh

demo: setup
	@$(VALVEFLOW_DEMO)

demo-opcua: setup
	@$(ENV) python -m valveflow_ros.ros.opcua_demo --output demo_output/opcua

test: setup
	@$(ENV) VALVEFLOW_REQUIRE_ROS=1 python -m pytest $(PARALLEL) $(PYTEST_ARGS)

test-versions: setup
	@failed=; for python in $(PYTHONS); do tree=$$(.venv/bin/python tools/versions.py $$python) && \
	  $(MAKE) -C $$tree test PYTHON=$$python || failed="$$failed $$python"; done; \
	  [ -z "$$failed" ] || { echo "test-versions: failed with$$failed" >&2; exit 1; }

test-slow: setup
	@$(ENV) VALVEFLOW_REQUIRE_ROS=1 VALVEFLOW_SLOW=1 python -m pytest -m 'slow or long or hypothesis' \
	  $(PYTEST_ARGS)

lint: setup
	@$(ENV) ruff check .
	@$(ENV) ruff format --check .
	@$(ENV) mypy $(STRICT)

format: setup
	@$(ENV) ruff check --fix .
	@$(ENV) ruff format .

bench: setup
	@$(ENV) for name in $(BENCHMARKS); do python -m benchmarks.$$name || exit 1; done

bench-gate: setup
	@$(ENV) python -m benchmarks.regression $(if $(BASE),--base $(BASE))

mutation: setup
	@$(ENV) mutmut run $(ONLY)

repeat: setup
	@$(ENV) for k in $$(seq $(or $(N),200)); do python -m pytest -q -p no:cacheprovider \
	  $$(shuf -e test/logs/test_*reco*.py test/ros/test_*state*.py test/test_state.py) || exit 1; done

torture: setup
	@$(ENV) python -m benchmarks.torture

study: setup
	@$(ENV) for name in $(STUDIES); do python -m benchmarks.$$name || exit 1; done
	@$(ENV) for recording in '1s --seeds 10 --first 5201' 'minute --seeds 100 --first 9401' \
	  'compressed --seeds 10 --first 1401'; do \
	  python -m benchmarks.thermal_study --kinds choked,sequence,integrated_input \
	  --recording $$recording || exit 1; done

study-diagnosis: setup
	@$(ENV) python -m benchmarks.diagnosis_study --kind null --seeds 150 --first 9000
	@$(ENV) for kind in hidden pair triple confounded outside slow; do \
	  python -m benchmarks.diagnosis_study --kind $$kind --seeds 20 --first 9000 --high 3 || exit 1; done
	@$(ENV) python -m benchmarks.diagnosis_study --seeds 20 --first 9100 --low 1 --high 1.5

certify-partition: setup
	@$(ENV) python -m benchmarks.partition --certify --kinds valve --sizes 305633

.venv-docs/.made: docs/requirements.txt
	@.venv/bin/python -m venv .venv-docs
	@.venv-docs/bin/python -m pip install --quiet --require-hashes --only-binary :all: -r docs/requirements.txt
	@touch $@

docs: setup .venv-docs/.made
	@$(ENV) python -m docs.make_site
	@NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet --strict
	@echo 'The site is in site/html; to look at it: python3 -m http.server -d site/html'

lock: setup
	@$(ENV) uv pip compile --quiet --universal --python-version 3.10 --generate-hashes \
	  --no-emit-index-url --custom-compile-command 'make lock' $(if $(UPGRADE),--upgrade) \
	  --output-file requirements.lock requirements.in

clean:
	@rm -rf .venv .venv-docs build install log site
