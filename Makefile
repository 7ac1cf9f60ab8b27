# Everything from nothing but Python 3.11, 3.12 or 3.13: `make setup`, `make demo`, `make test`, `make quick` and `make docs`.
PYTHON ?= python3
VENV := .venv

unexport PYTHONDONTWRITEBYTECODE  # modules are compiled once, not by each of the tests' processes

.PHONY: setup demo test pytest quick lint docs notebooks

setup: $(VENV)/installed

demo: $(VENV)/installed  # the README's
	$(VENV)/bin/deconf run --task curling --methods naive_rnn deconfounded --seeds 1 --resume

test: $(VENV)/installed  # side by side, since mypy uses one core
	$(MAKE) -j2 lint pytest

pytest: $(VENV)/installed
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n auto --dist worksteal

quick: $(VENV)/installed  # what one runs while editing
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n auto --dist worksteal -m "not slow"

lint: $(VENV)/installed
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

docs: $(VENV)/installed  # the site, docs/_build/html/index.html
	$(VENV)/bin/pip install -q -c constraints.txt --config-settings editable_mode=compat -e .[docs]
	OMP_NUM_THREADS=1 $(VENV)/bin/deconf site

notebooks: $(VENV)/installed  # the tutorials as docs/tutorials/*.ipynb
	$(VENV)/bin/pip install -q -c constraints.txt jupytext
	$(VENV)/bin/jupytext --from md:myst --to ipynb docs/tutorials/*.md

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'Python >= 3.11 is needed')"
	cd deconfounded && for name in assets benchmarks deconf envs experts; do test -e $$name || ln -s ../$$name; done
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install -q --no-compile -c constraints.txt torch  # a minute less: modules are compiled when imported
	$(VENV)/bin/pip install -q --no-compile -c constraints.txt --config-settings editable_mode=compat -e .[dev]  # a path, as editors need
	$(VENV)/bin/pip install -q --no-compile -c constraints.txt --no-deps dm_control  # for its MJCF; from 3.13 on the line above leaves it out
	touch $@
