# `make demo` and `make test` need nothing but Python 3.11+ and a network that reaches PyPI.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint format schema bench clean

demo: $(STAMP)
	$(BIN)/real2sim demo --out out/demo

test: $(STAMP)
	$(BIN)/python -m pytest -q -n auto --maxprocesses 4 --dist loadfile

lint: $(STAMP)
	$(BIN)/ruff check proto client server tests
	$(BIN)/ruff format --check proto client server tests
	$(BIN)/mypy -p real2sim_proto -p real2sim

format: $(STAMP)
	$(BIN)/ruff check --fix proto client server tests
	$(BIN)/ruff format proto client server tests

schema: $(STAMP)
	$(BIN)/python -m real2sim_proto.schema proto/schema
	$(BIN)/python -m real2sim_server.service.http.openapi docs/openapi.json

bench: $(STAMP)
	$(BIN)/real2sim bench render --json out/bench_render.json
	$(BIN)/real2sim bench serve --json out/bench_serve.json

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[server,dev]'
	@touch $@

clean:
	rm -rf $(VENV) out build dist
