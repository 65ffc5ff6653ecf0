# Two commands are enough: `make demo` and `make test`. Both create .venv, with exactly what the locks name, by hash, whatever is published later:
# what running needs from requirements.lock; what tests and benchmarks need besides from requirements-dev.lock.
PYTHON ?= python3
BIN := .venv/bin
.DEFAULT_GOAL := help

help:  ## what can be made
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile

.venv/installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "armwright needs Python 3.11 or newer; got $$($(PYTHON) --version). Try: make PYTHON=python3.12 ..."; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "python3 has no venv module here: apt-get install python3-venv"; exit 2; }
	@echo "Making .venv with $$($(PYTHON) --version); once."
	@$(PYTHON) -c 'import runpy, signal; signal.signal(signal.SIGINT, signal.SIG_DFL); runpy.run_module("venv", {}, "__main__")' .venv
	@$(call add,requirements.lock)
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .

.venv/installed-dev: requirements-dev.lock .venv/installed
	@$(call add,requirements-dev.lock)

.venv/witnesses: tests/witnesses.lock .venv/installed-dev
	@$(call add,tests/witnesses.lock)

# Names show that it goes on, where pip is silent or a wall of text. Bytecode is made at the end, by all processors together.
add = echo "Installing what $(1) names into .venv:"; rm -f $@; \
  { PYTHONUNBUFFERED=1 $(BIN)/pip install --disable-pip-version-check --no-deps --require-hashes --no-compile -r $(1) && touch $@; } \
  | { n=0; while read -r said what rest; do case $$said in \
    Collecting) n=$$((n + 1)); printf ' %s' "$${what%%=*}"; [ $$((n % 8)) != 0 ] || echo;; \
    Installing) [ $$((n % 8)) = 0 ] || echo; echo "... unpacking and compiling";; esac; done; }; \
  [ -e $@ ] && { $(BIN)/python -m compileall -q -j 0 .venv/lib >/dev/null 2>&1 || true; }

.DELETE_ON_ERROR:  # an installation that failed half-way is begun again

install: .venv/installed  ## create .venv and install what running needs

dev: .venv/installed-dev  ## add what tests and benchmarks need

demo: install  ## the whole job on the mock arm: move, calibrate, verify; writes out/demo/report.html
	$(BIN)/armwright demo --out out/demo

demo-gap: install  ## an effect hidden in the mock arm, found, added to the model and corrected on the arm; 2 to 6 minutes
	$(BIN)/armwright demo gap --out out/demo-gap

drills: install  ## faults of every kind on the mock arm: how soon noticed, what moved, what was lost (docs/drills.md); some minutes
	$(BIN)/armwright drill --mock

crossing: dev  ## 100,000 random sequences of requests that cross, on every kind of board, judged by the plant; a night. COUNT=1000 SEED=1
	$(BIN)/python -m tests.crossing --count $(or $(COUNT),100000) --seed $(or $(SEED),0)

journeys: dev  ## whole ways of a user on four arms that are not supplied, and the table of them; a quiet machine. SELECT="1_first_day --arms six"
	$(BIN)/python -m tests.journeys $(SELECT)

soak: dev  ## 24 simulated hours of table sessions, then an hour in real time beside busy processors; HOURS=1 MINUTES=10 for less
	$(BIN)/python -m benchmarks.soak.stepped --hours $(or $(HOURS),24)
	$(BIN)/python -m benchmarks.soak.realtime --minutes $(or $(MINUTES),60)

lint: dev  ## ruff, format check, mypy strict, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Lint runs beside the suite, which leaves a part of two processors idle while it waits for processes.
test: dev  ## everything that must hold, in eight to twelve minutes on two cores
	@$(MAKE) --no-print-directory -j2 lint suite

# Bytecode is kept whatever the environment says: a test's child process would compile everything anew.
suite: dev  ## the tests alone
	PYTHONDONTWRITEBYTECODE= $(BIN)/pytest -n 2 --dist worksteal $(SELECT)

CORTEX_M := gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm

# Nothing may be left out for want of a tool: what `make test` skips without it is installed first.
test-all: dev .venv/witnesses  ## make test, and what runs at night: every kind and drill, beside other people's clients
	@{ command -v arm-none-eabi-gcc && command -v qemu-system-arm; } >/dev/null || apt-get install -y -qq $(CORTEX_M) \
	  || { echo "the builds for Cortex-M need, as root: apt-get install $(CORTEX_M)"; exit 2; }
	@$(MAKE) --no-print-directory -j2 lint suite SELECT="-m ''"

.venv-lerobot/installed: armwright/lerobot_robot_armwright/pyproject.toml
	$(PYTHON) -m venv .venv-lerobot
	.venv-lerobot/bin/pip install --quiet --disable-pip-version-check pytest hypothesis 'lerobot[dataset]' -e . -e armwright/lerobot_robot_armwright
	@touch $@

test-lerobot: .venv-lerobot/installed  ## the plugin beside LeRobot itself, in an environment of its own: 7 GB, for the torch that it needs
	.venv-lerobot/bin/python -m pytest tests/armwright/test_lerobot_plugin.py

format: dev  ## let ruff write the format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: dev  ## the table of measured claims, beside peers in their own environments; SECTIONS="wire kinematics" for some
	$(BIN)/python -m benchmarks $(SECTIONS)

coverage-study: dev  ## do 95 % intervals of the calibration cover the truth? 400 simulated sessions of each sort (an hour)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.coverage

solver-study: dev  ## is the optimum of an identification a real one? 200 fresh cases an objective, some 40 minutes
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.solver_study

FUZZ_SECONDS ?= 60

.venv-fuzz/installed: tests/fuzz/requirements.lock
	$(PYTHON) -m venv .venv-fuzz
	.venv-fuzz/bin/pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r tests/fuzz/requirements.lock
	@touch $@

fuzz: dev .venv-fuzz/installed  ## coverage-guided fuzzing of every decoder and file reader, a minute each, and two million frames; FUZZ_SECONDS=600
	$(BIN)/python -m tests.fuzz.frames
	$(BIN)/python -c 'from tests.fuzz.targets import TARGETS; print(*TARGETS, sep="\n")' | while read -r target; do echo "$$target"; \
	  PYTHONPATH=.:$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') \
	  .venv-fuzz/bin/python -m tests.fuzz.coverage_guided "$$target" $(FUZZ_SECONDS) </dev/null || exit 1; done

firmware:  ## the reference boards' firmware for a Nucleo-F446RE, with its sizes, and what a call costs here (docs/firmware.md)
	@command -v arm-none-eabi-gcc >/dev/null || { echo "no compiler for Cortex-M: apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi"; exit 2; }
	$(MAKE) --no-print-directory -C firmware_iface/firmware host target cycles OUT=$(CURDIR)/out/firmware

firmware-fuzz:  ## the firmware under sanitizers: FUZZ_FRAMES=100000000 mutated frames for each board
	$(MAKE) --no-print-directory -C firmware_iface/firmware fuzz OUT=$(CURDIR)/out/firmware

firmware-difference: dev  ## the firmware in C against the mock's own in Python: CONVERSATIONS=100000 random ones, a minute
	$(BIN)/python -m tests.fuzz.firmware $(or $(CONVERSATIONS),20000) $(SEED)

mutants: dev  ## are the tests sharp? every small change of the safety layer (tests/mutants/survivors.toml), half an hour; SAMPLE=300 SEED=1 of the whole product, drawn by chance: an hour of one core, or two
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m tests.mutants.run $(MODULES) $(if $(SAMPLE),--sample $(SAMPLE) --seed $(or $(SEED),1))

screenshots: dev  ## the pictures of docs/console.md, from the mock arm without a terminal; some minutes
	$(BIN)/python -m tests.console.screen.screenshots docs

gap-score: dev  ## how often the gap workflow is right on poses, time series and the mock arm: fresh cases, six minutes; CASES=60 of each sort
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.gap.score $(if $(CASES),--cases $(CASES))

gap-orientation: dev  ## what measured orientations add to the gap workflow: wrist effects by position and with orientation, and nulls; CASES=20
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.gap.static.oriented $(if $(CASES),--cases $(CASES))

trust-study: dev  ## do 95 % ellipsoids of predicted tip errors hold the truth over the whole workspace? some minutes; CASES=20 arms of each sort
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.trust_coverage $(if $(CASES),--cases $(CASES))

iso9283-study: dev  ## do predicted ISO 9283 figures hold the measured ones on many simulated arms? some minutes; CASES=20 arms of each sort
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.iso9283_arms $(if $(CASES),--cases $(CASES))

planning-study: dev  ## what planned paths and stops gain on mock arms, measured by their camera before any correction; half an hour; CASES=6 of each sort
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.planning $(if $(CASES),--cases $(CASES))

owned-arms-study: dev  ## tip error of the arms of docs/arms.md on the mock, before and after an afternoon; some 20 minutes, CASES=3 arms of each sort, ARMS="so101 koch", SMALL=1 with small errors, WEBCAM=1 with rendered pictures
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.owned_arms $(if $(CASES),--cases $(CASES)) $(if $(ARMS),--arms $(ARMS)) $(if $(SMALL),--small) $(if $(WEBCAM),--webcam)

distances-study: dev  ## how well draw wires, gauges and pairs of poses calibrate the reference arm (docs/distances.md), a minute
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.calibration.distances

rough-score: dev  ## the same for poses of parts whose laws are only roughly right, up to six at once; CASES=60 of each sort
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.gap.static.rough_score $(if $(CASES),--cases $(CASES))

COMPILE := uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --no-header pyproject.toml

# What a lock has is left out of the next one, which only adds to it. setuptools builds the editable package.
lock:  ## pin again what pyproject.toml names (needs uv); UPGRADE=--upgrade takes the newest of everything
	sed -n 's/^requires = \["\(.*\)"\]/\1/p' pyproject.toml | $(COMPILE) - $(UPGRADE) -o requirements.lock
	$(call beside,requirements.lock,--extra dev) $(UPGRADE) -o requirements-dev.lock
	$(call beside,requirements.lock requirements-dev.lock,--group witnesses) $(UPGRADE) -o tests/witnesses.lock

beside = $(COMPILE) $(2) $(1:%=-c %) $$(sed -n 's/^\([a-z0-9-]*\)==.*/--no-emit-package \1/p' $(1))

clean:  ## remove what make made
	rm -rf .venv .venv-peers .venv-fuzz .venv-lerobot out .mypy_cache .ruff_cache .pytest_cache .import_linter_cache

.PHONY: $(shell sed -n 's/^\([a-z-]*\):.*\#\#.*/\1/p' $(MAKEFILE_LIST))
