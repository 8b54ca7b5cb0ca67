# make demo    the main job on a sample that needs no download; ARGS="--sample motorcycle"
# make test    the tests, side by side; ARGS="--runslow" for all of them
# make lint    what continuous integration asks of the code's form
# make docs    the documentation, in build/site
# make wheel   dist/*.whl
# make clean   removes what the above made, .venv included
#
# Each of them first sees to .venv and to the system libraries of open3d.
# make PYTHON=/path/to/python3 names another interpreter (>= 3.10).

BIN := .venv/bin
ARGS ?=

.PHONY: demo test lint docs wheel clean environment

demo: environment
	$(BIN)/gvtools demo $(ARGS)

# Where bytecode is written, workers and the commands that tests begin need not compile it again.
test: export PYTHONDONTWRITEBYTECODE :=
test: environment
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile \
		--no-loadscope-reorder $(ARGS)

lint: environment
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports
	$(BIN)/python .ci/budget.py

docs: environment
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "open build/site/index.html"

wheel: environment
	rm -rf build dist
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	rm -rf build
	ls -l dist/*.whl

environment:
	@PYTHON="$(PYTHON)" bash packaging/environment.sh
	@bash packaging/system_libraries.sh $(BIN)/python

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
