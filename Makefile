# Everything runs in .venv, which the first command makes. `make help` lists the commands.
#
# One environment serves them all: the tests train agents and the demo is itself tested, so two would
# hold nearly the same packages. That the core needs none of them is the business of tests/test_install.py.

PYTHON ?=
ARGS ?=
BIN := .venv/bin
# Where this is set, each of the many processes that tests start would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

# The oldest supported Gymnasium, Numba and NumPy, and the tests that are run on them too.
OLDEST_GYMNASIUM := 1.2.2
OLDEST_NUMBA := numba==0.61.0 llvmlite==0.44.0 numpy==2.0.2
NUMBA_TESTS ?= tests/test_golden.py tests/test_series.py tests/test_own_tasks.py
GYMNASIUM_TESTS ?= tests

.DEFAULT_GOAL := help
.PHONY: help setup demo baselines test test-slow notebooks test-libraries test-oldest lint types check audit bench bench-docs report report-docs submissions docs pictures format clean

help:  ## list the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' Makefile
	@echo "ARGS=... is passed on: make demo ARGS=--help, make test ARGS='-k vector'"

setup:  ## make or update .venv (all others do this first); PYTHON=... chooses a new one's interpreter
	@PYTHON="$(PYTHON)" sh tools/setup

demo: setup  ## train and evaluate an agent on PivotedBar-v0
	$(BIN)/python -m agents.demo $(ARGS)

baselines: setup  ## compute, train and measure all agents (hours; can be interrupted), write docs/agents.md
	$(BIN)/python -m agents.optimum
	$(BIN)/python -m agents.train all --algo ppo fast_ppo sac td3 tqc dqn --seeds 5
	$(BIN)/python -m agents.bench --output agents/results/adapter.json
	$(BIN)/python -m agents.results $(ARGS)

test: setup  ## run the tests and doctests, all but the slow ones
	@sh tools/browser
	$(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

# Times of frames would suffer from tests that run beside them.
ALONE = tests/test_drive_speed.py

test-slow: setup  ## install what the slow tests need (Pinocchio, Ray, the RL Zoo) and run them; it prints how long it took
	@sh tools/browser
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test,pinocchio,ray,zoo]'
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow --no-skips --durations 20 $(or $(ARGS),--ignore $(ALONE))
	$(if $(ARGS),,$(BIN)/python -m pytest -m slow --no-skips $(ALONE))

notebooks: setup  ## run the notebooks in full, from the wheel (minutes); the tests run a shorter version
	$(BIN)/python -m pytest -m slow --no-skips -s tests/test_notebooks.py $(ARGS)

test-libraries: setup  ## run libraries by their own scripts, each in its environment; ARGS='--docs' writes the page
	$(BIN)/python tools/libraries $(ARGS)

test-oldest: setup  ## run tests on the oldest supported Numba and NumPy, and all on the oldest Gymnasium
	@rm -rf .venv/oldest .venv/oldest-numba
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --target .venv/oldest-numba $(OLDEST_NUMBA)
	PYTHONPATH=$(CURDIR)/.venv/oldest-numba $(BIN)/python -m pytest -n 2 --dist worksteal $(NUMBA_TESTS)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--no-deps --target .venv/oldest gymnasium==$(OLDEST_GYMNASIUM)
	@PYTHONPATH=.venv/oldest $(BIN)/python -c \
		"from gymnasium import __version__ as v; print('Gymnasium', v); assert v == '$(OLDEST_GYMNASIUM)'"
	PYTHONPATH=$(CURDIR)/.venv/oldest $(BIN)/python -m pytest -n 2 --dist worksteal $(GYMNASIUM_TESTS) $(ARGS)

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-logo --no-cache

types: setup
	$(BIN)/python -m mypy

audit: setup  ## check that nothing on the leaderboard has changed since it was added
	$(BIN)/lag-envs leaderboard audit --pin src/lag_envs/leaderboard/pin.json --jobs 2 $(ARGS)

check: lint types test audit  ## all that CI runs: lint, types, tests, doctests, the board's audit

bench: setup  ## compare the speed with other environments
	$(BIN)/lag-envs bench $(ARGS)

bench-docs: setup  ## the same, written into docs and README; needs an otherwise idle machine
	$(BIN)/lag-envs bench --checkout . $(ARGS)

report: setup  ## measure errors and write a page about them, into the folder report; ARGS='--docs .' into docs too
	$(BIN)/lag-envs report $(ARGS)

report-docs: setup  ## take the folder report over into docs
	$(BIN)/python -m lag_envs.report.docs report

submissions: setup  ## make submissions of all our agents, from what `make baselines` left, in runs/submissions
	$(BIN)/python -m agents.board_values
	$(BIN)/python -m agents.submit runs/submissions $(ARGS)

docs: setup  ## build the documentation and the leaderboard's page as one site, into the folder site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict $(ARGS)

pictures: setup  ## write README's table of environments, and draw their moving pictures
	SDL_VIDEODRIVER=dummy $(BIN)/python -m tools.docs --pictures

format: setup  ## format the code and auto-fix what ruff can
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

clean:  ## remove caches and build products (not .venv, not what was trained)
	rm -rf build dist .coverage .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find src tests agents -name __pycache__ -prune -exec rm -rf {} +
