# `make` lists the targets. Each does all the set-up it needs; a second call skips what is done.
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= lidarpool-out

.DEFAULT_GOAL := help
.PHONY: help demo test test-all durations slow dist release lock compat chaos mutants soak lint docs format bench clean dev

# Where Python may not write what it has compiled, as in containers, each of the many processes of a
# run or of the tests would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /\1\t/' | expand -t 10

dev:
	@VENV=$(VENV) sh .ci/setup dev

demo:  ## the demo survey, then a drive through a city; results in $(OUT)/ and $(OUT)/drive/
	@VENV=$(VENV) sh .ci/setup run
	$(BIN)/lidarpool demo --out $(OUT)
	@mkdir -p $(OUT)/drive && cp examples/drive.yaml $(OUT)/drive
	$(BIN)/lidarpool scene city $(OUT)/drive/city.glb --overwrite
	$(BIN)/lidarpool run $(OUT)/drive/drive.yaml --out $(OUT)/drive --overwrite --pictures
	@echo
	@echo "Next, look at the drive:   $(BIN)/lidarpool view $(OUT)/drive"
	@echo "and scan a mesh of yours:  $(BIN)/lidarpool run YOUR.glb --out $(OUT)/yours"

# Whole runs wait for processes and timers: three processes keep two cores busy. The tests of a
# file stay together, for they share clusters; tests/conftest.py puts the longest files first.
PYTEST := $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test: dev  ## one test of each kind of behavior: five minutes
	$(TIMED) $(PYTEST) $(MORE)

test-all: dev  ## all tests but the slow ones: what CI runs
	$(PYTEST) -m "not slow" $(MORE)

durations: dev  ## seconds of each file of tests, into tests/durations.json; on a quiet machine
	$(PYTEST) -m "not slow" --junitxml=build/junit.xml
	$(BIN)/python .ci/durations.py build/junit.xml >tests/durations.json

slow: dev  ## the tests that take seconds to minutes each
	@VENV=$(VENV) sh .ci/setup slow
	$(BIN)/python -m pytest -m slow

dist: dev  ## source distributions and wheels of all six distributions, checked, in dist/
	@.ci/dist $(BIN)/python

release: dev  ## check that this commit can be released: versions, changelog, tag, placeholders, links, wheels
	@$(BIN)/python .ci/release.py
	$(MAKE) lint dist

lock:  ## newest versions of all dependencies, with hashes, into requirements/; OPTIONS="--upgrade-package numpy" for one
	@.ci/lock $(OPTIONS)

compat:  ## the tests with the oldest, the newest and the locked versions of the dependencies, on four Pythons
	@sh .ci/compat

chaos: dev  ## 200 faults at every point of a survey, and damage of files; SEED=n plays them again
	$(BIN)/python -m tests.chaos --faults 200 $(if $(SEED),--seed $(SEED))
	$(BIN)/python -m tests.chaos.damage --count 3 --seconds 60 $(if $(SEED),--seed $(SEED))
	$(BIN)/python -m tests.chaos.local_runs --faults 24 $(if $(SEED),--seed $(SEED))
	$(BIN)/python -m tests.chaos.balancing --faults 60 $(if $(SEED),--seed $(SEED))
	$(BIN)/python -m tests.chaos.sharing --faults 50 $(if $(SEED),--seed $(SEED))

mutants: dev  ## COUNT faults planted in the sources (default 20), and which of them no test notices; SEED=n draws them again
	$(BIN)/python -m tests.mutants --count $(or $(COUNT),20) $(if $(SEED),--seed $(SEED)) $(PACKAGES)

soak: dev  ## 10,000 scans with a worker killed every few seconds; memory as a picture in $(OUT)/
	$(BIN)/python -m tests.chaos.soak --picture $(OUT)/soak.png

SOURCES := kernels scheduler workflows tests benchmarks examples docs

lint: dev docs  ## format check, lint, types, spelling, names, layers, documentation; prints lines per package
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/codespell
	$(BIN)/codespell --builtin en-GB_to_en-US --regex '[A-Za-z][a-z]+' .ci $(SOURCES)  # identifiers
	$(BIN)/lint-imports
	$(BIN)/python .ci/names.py
	$(BIN)/python .ci/stubs.py --check
	$(BIN)/python .ci/lines.py --check

docs: dev  ## the documentation as a site in build/site; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

format: dev  ## rewrite the sources in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: dev  ## benchmarks: scheduler and driver, ray casting, trees; figures of the last two in build/ as JSON
	$(BIN)/python -m benchmarks.scale
	@mkdir -p build
	$(BIN)/python -m benchmarks.raycast --json build/raycast.json
	$(BIN)/python -m benchmarks.trees --json build/trees.json

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
