# Targets are listed by `make` alone. Everything runs inside .venv, which `make setup` prepares.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
PYTHONS ?= python3.12 python3.13
LOCKED := --progress-bar off --disable-pip-version-check --no-deps --require-hashes -r requirements-dev.lock
# Tests run in many processes: what the first compiles, the others need not (an empty value counts as none).
TESTS := -m pytest -n 3 --dist loadfile --no-loadscope-reorder
test test-all coverage lowest newest pythons: export PYTHONDONTWRITEBYTECODE :=
# Threads of linear algebra in three processes compete for two cores.
test test-all coverage lowest newest pythons: export OPENBLAS_NUM_THREADS := 1
ITSELF := --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .

.PHONY: $(shell sed -n 's/^\([a-z -]*\):.*\#\# .*/\1/p' $(firstword $(MAKEFILE_LIST)))

help: ## list the targets
	@grep -hE '^[a-z -]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

setup: $(STAMP) ## prepare .venv with exactly the locked versions

$(STAMP): pyproject.toml requirements-dev.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "uwbcal needs Python 3.11 or newer, and $(PYTHON) is $$($(PYTHON) --version 2>&1); try make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(LOCKED)
	$(BIN)/python -m pip install $(ITSELF)
	@touch $@

demo: setup ## simulate three flights, fit, evaluate, localize; writes demo/report.html
	@mkdir -p demo
	$(BIN)/uwbsim run scenarios/icra2023/train.toml -o demo/train.uwb --force
	$(BIN)/uwbsim run scenarios/icra2023/test1.toml -o demo/test1.uwb --force
	$(BIN)/uwbsim run scenarios/icra2023/test2.toml -o demo/test2.uwb --force
	$(BIN)/calib fit demo/train.uwb -o demo/calibration.json --force
	$(BIN)/calib evaluate demo/test1.uwb demo/test2.uwb -c demo/calibration.json
	$(BIN)/calib report demo/train.uwb --tests demo/test1.uwb demo/test2.uwb -o demo/report.html --force

test: setup ## run the tests but the slow ones; three processes, for two cores: many tests wait for boards
	$(BIN)/python $(TESTS) -m "not slow"

test-all: setup ## run the whole test suite, slow tests too (a quarter of an hour on two cores)
	$(BIN)/python $(TESTS)

docs: setup ## build the documentation site into docs/_build/html; warnings are errors (a minute)
	$(BIN)/python -m sphinx -q -W --keep-going -j 2 docs docs/_build/html
	$(BIN)/python -m docs.site.narrow
	@echo "open docs/_build/html/index.html"

coverage: setup ## run the whole test suite and measure what it reaches (15 minutes); fails below 92 %
	$(BIN)/python $(TESTS) --cov --cov-report=term-missing

rooms: setup ## print which room imports which, floor by floor
	$(BIN)/python -m tests.rooms

lowest newest: ## run the whole test suite on the lowest versions that pyproject.toml allows, or on the newest
	$(PYTHON) -m venv .venv-$@
	$(PYTHON) -m tests.bounds $@ > .venv-$@/requirements.txt
	.venv-$@/bin/python -m pip install --quiet --disable-pip-version-check --upgrade -r .venv-$@/requirements.txt
	.venv-$@/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation .
	.venv-$@/bin/python $(TESTS)

pythons: ## run the whole test suite on other Pythons, with the locked versions; PYTHONS names them (10 minutes each)
	for python in $(PYTHONS); do \
		own=.venv-$$(basename $$python); \
		$$python -m venv $$own && $$own/bin/python -m pip install $(LOCKED) && \
		$$own/bin/python -m pip install $(ITSELF) && \
		$$own/bin/python $(TESTS) || exit; \
	done

fuzz: setup ## run commands on 2000 damaged files and options (10 minutes)
	$(BIN)/python -m tests.fuzz.commands

mutants: ## put faults into the code (mutmut) and name those that no test notices; FAULTS="uwblink.twr.*" limits them
	$(PYTHON) -m venv .venv-mutants
	.venv-mutants/bin/python -m pip install $(LOCKED)
	.venv-mutants/bin/python -m pip install $(ITSELF)
	.venv-mutants/bin/python -m pip install --quiet --disable-pip-version-check mutmut==3.8.1
	.venv-mutants/bin/mutmut run --max-children 2 $(FAULTS)
	.venv-mutants/bin/mutmut results

lint: setup ## check style (ruff) and types (mypy)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup ## rewrite the code in the house style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

picture: setup ## draw the README's picture; DATA=folder, with public data sets, adds a recorded flight
	$(BIN)/python -m benchmarks.picture $(DATA)

bench: setup ## measure speed and memory, and beside plain scripts; prints the first two tables of docs/speed.md
	$(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.ratios

ratios: setup ## fail where the packages take far longer than plain scripts (1 minute)
	$(BIN)/python -m benchmarks.ratios --check

bench-large: setup ## measure a calibration of 3.8 million exchanges (two minutes, 2 GB)
	$(BIN)/python -m benchmarks.large

bench-workbench: setup ## measure engines, workers and Dask (2 minutes)
	$(BIN)/python -m benchmarks.workbench

bench-stream: setup ## measure how late streamed ranges are (15 s)
	$(BIN)/python -m benchmarks.streaming

bench-hours: setup ## record eight hours in virtual time, then all commands on 5.8 million exchanges (half an hour, 2 GB of disk)
	$(BIN)/python -m benchmarks.hours record 8 long.uwb
	$(BIN)/python -m benchmarks.hours commands long.uwb

bench-import: setup ## measure how long tables and poses take to come in (2 minutes, 1 GB)
	$(BIN)/python -m benchmarks.importing

trajectories: setup ## fits without known distances over 50 seeds a world, into docs/accuracy.md (30 minutes)
	$(BIN)/python -m benchmarks.trajectories --write

plans: setup ## plans of flights beside fits of them, into docs/accuracy.md (15 minutes)
	$(BIN)/python -m benchmarks.plans --write

golden: setup ## fit some forty cases again and compare with tests/golden/fits.json (5 minutes)
	$(BIN)/python -m benchmarks.golden

accuracy: setup ## write docs/accuracy.md: 200 seeds, planted beside fitted (15 minutes)
	$(BIN)/python -m benchmarks.accuracy

campaigns: setup ## what a training flight needs, into docs/motion-capture.md (5 minutes)
	$(BIN)/python -m benchmarks.campaigns

worlds: setup ## fits in worlds that share nothing with the simulator, into docs/accuracy.md (20 minutes)
	$(BIN)/python -m benchmarks.worlds_report

places: setup ## fits where errors belong to places, into docs/accuracy.md (20 minutes)
	$(BIN)/python -m benchmarks.rooms --write

dependences: setup ## patterns, slopes over temperature and drifts, into docs/accuracy.md (20 minutes)
	$(BIN)/python -W ignore -m benchmarks.dependences --write

surveys: setup ## survey worlds of standing boards, 50 seeds each, into docs/accuracy.md (10 minutes)
	$(BIN)/python -m benchmarks.surveys --write

sound: setup ## false alarms of the checks on sound recordings of 19 worlds, then planted faults (1 hour)
	$(BIN)/python -W ignore -m benchmarks.sound_recordings
	$(BIN)/python -W ignore -m benchmarks.sound_recordings --planted --seeds 4

doctor-table: setup ## write docs/doctor.md's table: planted faults, hits and false alarms (15 minutes)
	$(BIN)/python -W ignore -m benchmarks.doctor

bench-boards: setup ## measure driver, recorder and served boards (5 minutes)
	$(BIN)/python -m benchmarks.boards

twins: setup ## how well twins of simulated recordings find what was planted, over six seeds (3 minutes)
	$(BIN)/python -m benchmarks.twins --seeds 6

scoreboard: setup ## write docs/real-data.md from public data sets in a folder: make scoreboard DATA=folder (3 minutes)
	@test -n "$(DATA)" || { echo "make scoreboard DATA=folder: which folder has the data sets?"; exit 2; }
	$(BIN)/python -m benchmarks.scoreboard "$(DATA)"

fidelity: setup ## write a section of docs/accuracy.md, simulated beside measured
	$(BIN)/python -m benchmarks.fidelity

endurance: setup ## kill the recorder 50 times, and serve boards for 10 minutes
	$(BIN)/python -m benchmarks.endurance

LOCK = env UV_CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/uv pip compile pyproject.toml --quiet --group dev --all-extras \
	--universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url --output-file requirements-dev.lock

lock: setup ## add to requirements-dev.lock what pyproject.toml asks for now, with hashes; other versions stay
	$(LOCK)

upgrade: setup ## the same with the newest versions of everything
	$(LOCK) --upgrade

licences: setup ## write docs/licences.md: what licences everything in the lock has; fails for one that is incompatible
	$(BIN)/python -m tests.licences

installed: setup ## build wheel and sdist, install the wheel into an empty environment, run the README's commands there (3 minutes)
	$(BIN)/python -m tests.installed

clean: ## remove .venv, caches and the demo
	rm -rf .venv .venv-* demo .mypy_cache .ruff_cache .pytest_cache .hypothesis docs/_build docs/generated
