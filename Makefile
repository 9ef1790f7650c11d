# make help lists the targets. VENV: where the environment stands; ARGS: more arguments for the command;
# PYTHON: the interpreter to build on; JOBS: processes that run the tests.
VENV ?= .venv
JOBS ?= 2
python := $(VENV)/bin/python
# When a test ends its process, the run ends, too: in a new process, xdist would run the same test again.
in_parallel := -n $(JOBS) --max-worker-restart 0

.PHONY: help setup train test wheel-test extras accelerators accelerators-test lint audit docs clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## /make \1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 24

setup:  ## the environment: pinned packages and, where it is missing, OpenGL
	@scripts/setup.sh "$(VENV)"
	@scripts/opengl.sh "$(VENV)"

train: setup  ## simulate, train, generate, evaluate, report: the preset tiny
	@$(python) -m experiments.train tiny $(ARGS)

test: setup  ## the tests
	@$(python) -m pytest $(in_parallel) $(ARGS)

wheel-test:  ## the wheel alone, in an empty environment outside the checkout: demo, generate, finetune, play, serve
	@scripts/wheel.sh

extras: setup  ## the optional packages (networks, PyTorch, Rerun, a browser), and the tests that want them
	@scripts/extras.sh "$(VENV)"
	@"$(VENV)/extras/bin/python" -m pytest $(in_parallel) $$(grep -rlE --include='test_*.py' 'importorskip\("(torch|trans|rerun|playwright|stable|hugging)' tests) $(ARGS)

accelerators: setup  ## compilers for GPUs and TPUs that are not here (5.1 GB), for experiments.compile
	@scripts/accelerators.sh "$(VENV)"

accelerators-test: accelerators  ## the tests that compile for them
	@"$(VENV)/accelerators/bin/python" -m pytest $(in_parallel) tests/tools/compile $(ARGS)

lint: setup  ## ruff, mypy, and the numbers that may only fall
	@$(python) -m ruff check
	@$(python) -m ruff format --check
	@$(python) -m mypy
	@$(python) -m scripts.ratchets

audit: setup  ## known vulnerabilities of the pinned packages, by PyPI's advisories (needs the network)
	@scripts/audit.sh "$(VENV)"

docs: setup  ## the documentation as a site, in site/; open site/index.html
	@scripts/docs.sh "$(VENV)"
	@NO_MKDOCS_2_WARNING=1 $(python) -m mkdocs build --strict --quiet $(ARGS)

clean:  ## removes the environment, the caches and what was built; data and runs stay
	@rm -rf "$(VENV)" build dist site rsjax.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	@find rsjax experiments benchmarks scripts tests -name __pycache__ -prune -exec rm -rf {} +
