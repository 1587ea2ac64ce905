# `make` lists the targets. Each does all the set-up it needs; a second call skips what is done.
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= lidarpool-out

.DEFAULT_GOAL := help
.PHONY: help demo test slow compat chaos soak lint docs format bench clean

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /\1\t/' | expand -t 10

demo:  ## run the default survey on a local cluster; results in $(OUT)/
	@VENV=$(VENV) sh .ci/setup run
	$(BIN)/lidarpool demo --out $(OUT)

test:  ## run the test suite
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/python -m pytest

slow:  ## the tests that take minutes, which `test` leaves out
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/python -m pytest -m slow

compat:  ## poolpart's tests with the lowest and the newest Dask, and with Dask's main
	@sh .ci/compat

chaos:  ## 200 faults, every kind at every point of a survey; SEED=n plays them again
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/python -m tests.chaos --faults 200 $(if $(SEED),--seed $(SEED))

soak:  ## 10,000 scans with a worker killed every few seconds; memory as a picture in $(OUT)/
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/python -m tests.chaos.soak --picture $(OUT)/soak.png

lint: docs  ## format check, lint, types, layer contracts, documentation
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs:  ## the documentation as a site in build/site; a warning is an error
	@VENV=$(VENV) sh .ci/setup dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

format:  ## rewrite the sources in the project's format
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench:  ## benchmarks: pipeline, planning, live page, ray casting; figures of the last in build/ as JSON
	@VENV=$(VENV) sh .ci/setup dev
	$(BIN)/python -m benchmarks.pipeline
	$(BIN)/python -m benchmarks.scale
	$(BIN)/python -m benchmarks.planning
	$(BIN)/python -m benchmarks.live
	@mkdir -p build
	$(BIN)/python -m benchmarks.raycast --json build/raycast.json
	$(BIN)/python -m benchmarks.trees --json build/trees.json

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
