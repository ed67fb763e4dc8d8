# Every target does its own set-up (scripts/setup), which is quick the second time. Paths are relative, so the folder may
# lie anywhere.
.DEFAULT_GOAL := help
.PHONY: help setup demo docs kernels test test-slow test-readers test-container torture fuzz lint bench bench-engines bench-peers bench-scaling bench-feed bench-device bench-variety bench-detectors detector-weights bars-nav-a bars-nav-b bars-nav-b-blender bars-nav-c bars-nav-d bars-nav-e bars-nav-docking publish clean
SHELL := /bin/bash
BIN := .venv/bin

help: ## this list
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1|\2/p' Makefile | while IFS='|' read -r name text; do \
	  printf '%-18s %s\n' "$$name" "$$text"; done

setup: ## make .venv with everything in it (all extras)
	@scripts/setup all

demo: ## render a small dataset, navigate on it blind, and report how accurate the poses are (installs core and Mitsuba)
	@scripts/setup mitsuba
	@echo "demo: rendering, navigating and scoring into out/demo; the first report comes after 12 pairs"
	@$(BIN)/droguekit demo --out out/demo
	@echo "demo: the report is $(CURDIR)/out/demo/report.html"

docs: ## build the documentation into out/docs (installs mkdocs-material and mkdocstrings)
	@scripts/setup docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "docs: open $(CURDIR)/out/docs/index.html"

# Three processes for two cores: tests of commands and pages spend much of their time waiting for other processes.
# A process that crashes ends the run and names its test: if it were replaced, the others might wait for ever
# (pytest-xdist 3.8).
PYTEST := $(BIN)/python -m pytest --numprocesses 3 --dist loadfile --max-worker-restart 0
test: setup ## linters, types and the fast tests
	@$(MAKE) --no-print-directory --jobs 2 --output-sync=target lint kernels
	@echo "test: pytest, the fast tests"
	@$(PYTEST) -m "not slow"

test-slow: setup kernels ## the tests that take longer
	@echo "test-slow: pytest, the slow tests"
	@$(PYTEST) -m "slow and not torture"

# Before processes of the tests start side by side: each would compile the same loops, for a minute.
kernels: setup ## compile the loops that numba keeps on disk
	@echo "kernels: compiling loops"
	@$(BIN)/python -m tests.support.compiled_kernels

test-readers: setup ## read the exports with datasets, datumaro, evo, FiftyOne, Label Studio's SDK and ultralytics (installs them under out/readers)
	@scripts/readers

test-container: ## build the container image with buildah and try it (minutes; as root; needs buildah and debootstrap)
	@scripts/test-container

torture: setup ## kill a run of 200 pairs 50 times, and compare the result with an undisturbed run (minutes)
	@$(BIN)/python -m pytest tests/batch -m torture --capture=no

fuzz: setup ## 10,000 damaged and hostile files through every reader, validate and every export (minutes)
	@DROGUEKIT_FUZZ_TIMES=20 $(BIN)/python -m pytest tests/fuzz

lint: setup ## formatting, style, types, walls between the packages, links of the documentation
	@echo "lint: ruff, import-linter, mypy, mkdocs"
	@$(BIN)/ruff format --check --quiet . || { echo "lint: run .venv/bin/ruff format"; exit 1; }
	@$(BIN)/ruff check --quiet .
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/mypy
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench-engines: ## the same frames by Mitsuba and by Blender: do they agree? (an hour; installs Blender; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.engine_agreement --out out/engine-agreement

bench-peers: ## CPU seconds per pair of droguekit, plain Cycles and plain Mitsuba at equal noise (hours; installs Blender; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.render_cost --out out/peer-comparison

bench-scaling: ## two workers against one on 200 pairs, and the overhead per frame (minutes, on an idle machine; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.scaling --out out/scaling

bench-device: ## pairs per second and watts on a GPU beside LLVM, and do they agree? (minutes, on an idle machine with a GPU)
	@scripts/setup mitsuba
	@$(BIN)/python -m studies.render_devices

bench-feed: ## how much of its time a training waits for pairs that are rendered meanwhile (minutes, on an idle machine)
	@scripts/setup all
	@$(BIN)/python -m studies.training_feed --out out/training-feed

bench-variety: ## how much drogues, tankers and probes differ between scenes, and sheets of them all (an hour; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.world_variety measure --out out/world-variety world-89 world-real
	@$(BIN)/python -m studies.world_variety sheets --out out/world-variety

CORPUS ?= out/detector/datasets/detector-small
bench-detectors: ## detectors OURS=FILE.onnx beside seven of other projects, trained on CORPUS=DIR and timed in turns (hours; installs ultralytics and libreyolo; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.detector_comparison --out out/detector-peers --corpus $(CORPUS) $(foreach file,$(OURS),--ours $(file))

detector-weights: ## make the shipped mobile-l anew: photographs, corpora, five trainings, scores (hours; Debian 12; NVIDIA GPU; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.detector_weights --out out/detector-weights

bench: ## CPU seconds per stereo pair by distance and stage, and pairs per second of all workers
	@scripts/setup mitsuba
	@$(BIN)/droguekit bench

bars-nav-a: ## acceptance, tier A: analytic images, day and dusk, 400 pairs per distance (hours; resumes)
	@scripts/setup mitsuba
	@$(BIN)/python -m studies.acceptance a --out out/bars/a

bars-nav-b: ## acceptance, tier B: path-traced images, day and dusk, 64 pairs per distance (hours; resumes)
	@scripts/setup mitsuba
	@$(BIN)/python -m studies.acceptance b --out out/bars/b

bars-nav-b-blender: ## acceptance, tier B by the engine Blender (hours; installs Blender; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.acceptance b --out out/bars/b-blender --engine blender

bars-nav-c: ## acceptance, tier C: noise, mirrored tilts, covariances and tolerances with drawn centroids (minutes)
	@scripts/setup mitsuba
	@$(BIN)/python -m studies.acceptance c --out out/bars/c

bars-nav-d: ## acceptance, tier D: wrong markers, with drawn centroids (minutes)
	@scripts/setup mitsuba
	@$(BIN)/python -m studies.acceptance d --out out/bars/d

bars-nav-e: ## acceptance, tier E: sequences behind a swinging drogue, with tracker and filter (hours; resumes)
	@scripts/setup mitsuba
	@$(BIN)/python -m studies.acceptance e --out out/bars/e

bars-nav-docking: ## acceptance of whole docking runs, by both engines, and with two more sensors (days; resumes)
	@scripts/setup all
	@$(BIN)/python -m studies.acceptance docking --out out/bars/docking --engine mitsuba --engine blender --rig rgb-ideal --rig paper-colour --rig mono

publish: ## make the published manifests of the small recipes again, after a change of pixels or recipes (minutes)
	@scripts/setup mitsuba
	@rm -rf out/publish
	@$(BIN)/python -m studies.publish --work out/publish --out datasets_manifest/published

clean: ## remove the environment, caches and build results; out/ stays
	rm -rf .venv .bootstrap build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -not -path './out/*' -prune -exec rm -rf {} +
