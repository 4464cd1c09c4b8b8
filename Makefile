# Two commands set everything up: `make demo` to see it work, `make test` to check it. `make explore` shows a trained agent,
# `make docs` builds the documentation.
PYTHON ?= python3
BIN := .venv/bin

# Networks this small are faster on one torch thread; the other cores are for other processes.
export OMP_NUM_THREADS := 1

.PHONY: install demo docs explore test

install: .venv/installed

.venv/installed: constraints.txt setup.cfg pyproject.toml
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" || { \
		echo "Python 3.11 or newer is needed, and $(PYTHON) is older or missing: try 'make PYTHON=python3.12 $(MAKECMDGOALS)'." >&2; \
		exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --disable-pip-version-check -c constraints.txt -e ".[tests]"
	touch $@

demo: install
	$(BIN)/sb3-skillgraph demo --out runs/demo

docs: install
	$(BIN)/pip install --disable-pip-version-check -q -c constraints.txt -e ".[docs]"
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html
	$(BIN)/sphinx-build -W --keep-going -q -b doctest docs docs/_build/doctest
	@echo "the pages are docs/_build/html/index.html"

explore: install
	$(BIN)/sb3-skillgraph explore examples/agents/point_medium

test: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2 --dist loadfile -m "not browser"
