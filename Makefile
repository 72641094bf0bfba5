# Everyday commands of this clone. Each brings the set-up up to date first; `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help
unexport PYTHONPATH PYTHONHOME VIRTUAL_ENV PYTHONDONTWRITEBYTECODE
export PYTHONNOUSERSITE := 1

bin := .venv/bin
ARGS ?=

.PHONY: help setup scan test rig check bench tables docs clean

help: ## this list
	@sed -nE 's/^([a-z]+):.*## (.*)/make \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 14

setup: ## install what is missing, compile the kernels
	@setup/install.sh

scan: setup ## scan the simulated rig; ARGS="--method mcp" and the like are passed on
	@setup/scan.sh $(ARGS)

test: setup ## all tests; ARGS="-k config" and the like are passed on
	@setup/firmware-tools.sh
	@# Tests share the processors, long files first; those that watch the clock go one by one. 5: none was asked for.
	@run() { $(bin)/python -m pytest -q "$$@" $(ARGS) || [ $$? -eq 5 ]; }; \
	    run -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m "not alone" && run -m alone
	@setup/rig.sh told

rig: ## drivers against the kernel's virtual devices, the service under systemd: in a guest under QEMU
	@setup/install.sh --no-kernels
	@setup/rig.sh

check: ## format, lint, types, layers
	@setup/install.sh --no-kernels
	@$(bin)/ruff format --check .
	@$(bin)/ruff check .
	@$(bin)/mypy
	@$(bin)/lint-imports

bench: setup ## the benchmarks, one after the other; fails in the end if one missed its figures
	@missed=; for bench in $$(grep -l __main__ bench/*.py); do echo "== $$bench"; \
	    $(bin)/python $$bench || missed="$$missed $$bench"; done; [ -z "$$missed" ] || { echo "missed:$$missed"; exit 1; }

tables: setup ## the dissertation's tables on the simulated rig, into docs/; ARGS="5.1 gamma" makes some
	@cd bench && ../$(bin)/python -m tables $(ARGS)

docs: setup ## write the generated pages of the documentation anew
	@$(bin)/python docs/generate.py

install: ## as a service, for root: PREFIX=/usr/local, DESTDIR= for packagers
	@setup/install-system.sh

uninstall: ## undo install; rig file, captures and scans are kept
	@setup/install-system.sh --remove

clean: ## remove everything that set-up and tests made; scans are kept
	rm -rf .venv .setup .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache build dist *.egg-info
	find scanner drivers service tests bench docs -name __pycache__ -prune -exec rm -rf {} +
