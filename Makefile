# Every target sets up what it needs in .venv; see tools/environment.py.
# Needed beforehand: Python 3.11 or newer, make, and a C compiler (or none: make test brings one).

PYTHON ?= python3
UV ?= uv
WORKERS ?= auto
PYTEST_ARGS ?=

bin := .venv/bin
setup = @command -v $(PYTHON) >/dev/null 2>&1 || \
	{ echo "setup: there is no $(PYTHON) here. Install Python 3.11 or newer, or name it: make PYTHON=/path/to/python3" >&2; exit 1; }; \
	UV="$(UV)" $(PYTHON) tools/environment.py

# Workers share the cores, so the linear algebra below them takes one thread each; a file stays with
# one worker, which then builds its filters once.
pytest := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(bin)/python -m pytest -n $(WORKERS) --dist loadfile

sphinx := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(bin)/python -m sphinx -c docs -d build/doctrees

.DEFAULT_GOAL := help
.PHONY: help demo test test-all floats bench alarms firmware fuzz proofs docs docs-links lint golden golden-check wheel-check clean distclean

help: ## say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1@\2/p' Makefile | awk -F@ '{ printf "%-20s %s\n", $$1, $$2 }'
	@echo "  Variables: PYTHON=$(PYTHON)  UV=$(UV) (empty: use pip)  WORKERS=$(WORKERS)  PYTEST_ARGS=$(PYTEST_ARGS)"

demo: ## generate, compile and run a filter on an example
	@echo "demo: sets up .venv first if need be, then builds two filters and runs them; at most a minute"
	$(setup) run
	$(bin)/fkgen demo

test: ## run the tests: every family against its oracle, mutants, bits of the C, bad input, examples
	$(setup) test
	$(pytest) $(PYTEST_ARGS)

test-all: ## run what takes long too: all compilers, standards and levels, sanitizers, long Monte Carlo
	$(setup) test
	$(pytest) -m "not floats" $(PYTEST_ARGS)

floats: ## judge the elementary functions of float at every float there is: an hour
	$(setup) test
	$(pytest) -m floats $(PYTEST_ARGS) tests/compiled

bench: ## measure speed, next to other libraries
	$(setup) bench
	$(bin)/python bench/run.py

alarms: ## have Frama-C look for run-time errors in every example of at most four states
	$(setup) run
	$(bin)/python tools/alarms.py

firmware: ## run all examples on emulated processors and compare bits; figures as a table
	$(setup) test
	$(bin)/python tools/firmware.py

fuzz: ## call the C of all examples with any bits in any order, under sanitizers: a minute each at most
	$(setup) test
	$(bin)/python tools/fuzz.py

proofs: ## have Coq check the algebra of the filters, and Gappa's bound of rounding in float
	$(setup) run
	$(bin)/python tools/proofs.py

docs: ## build the site in build/site, notebooks run; a link that leads nowhere fails
	$(setup) docs
	$(sphinx) -E -n -W --keep-going -q -b html . build/site
	@echo "docs: build/site/index.html"

docs-links: ## ask every address outside whether it is there
	$(setup) docs
	$(sphinx) -q -b linkcheck . build/links

lint: ## check style, types, floors and the budget
	$(setup) test
	$(bin)/ruff check
	$(bin)/ruff format --check
	$(bin)/mypy --strict fkgen
	$(bin)/lint-imports
	$(bin)/python tools/budget.py
	$(bin)/python tools/repetition.py

golden: ## write generated/ anew; read the diff before you commit it
	$(setup) run
	$(bin)/python tools/golden.py --update

golden-check: ## say whether generated/ is what fkgen generates
	$(setup) run
	$(bin)/python tools/golden.py

wheel-check: ## build the wheel, install it elsewhere and use it
	$(setup) test
	$(bin)/python tools/wheel_check.py

clean: ## remove what builds and checks leave behind
	rm -rf build dist .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## remove .venv too
	rm -rf .venv .venv.lock
