# Everything here needs nothing but Python 3.11+ and a network that reaches PyPI.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SOURCES := proto client server benchmarks examples tests scripts docs/conf.py docs/images/make.py
# Cache bytecode even where the environment says not to: else every test process compiles it anew.
unexport PYTHONDONTWRITEBYTECODE
# Without -q, so that the header shows the random seed; --randomly-seed=N repeats that order.
PYTEST := $(BIN)/python -m pytest
# One process more than cores, since many tests wait: for a worker, a time limit, a page.
PARALLEL := -n $(shell $(PYTHON) -c "import os; print(min(4, os.cpu_count() + 1))") --dist loadfile --no-loadscope-reorder

# The tests of `make check`: contract, SDK, layers, and the quick files of the large packages. With
# lint they take two minutes.
FAST := tests/test_architecture.py tests/test_docs.py tests/proto tests/client \
	tests/server/geometry tests/server/edit \
	$(addprefix tests/server/scene/, test_camera.py test_cloud.py test_scene.py test_trajectory.py \
	  io/test_bundle.py io/test_splats.py) \
	$(addprefix tests/server/physics/, test_layout.py test_materials.py test_materials_contract.py \
	  test_matrices.py test_solver.py) \
	$(addprefix tests/server/world/, storyboard test_path.py test_recording.py test_reverse.py \
	  test_scores.py test_traffic.py test_vehicle.py test_world.py) \
	$(addprefix tests/server/service/, test_sdk.py sessions/test_bad_clients.py \
	  sessions/test_deadlines.py sessions/test_drive.py sessions/test_lockstep.py \
	  sessions/test_rest.py sessions/test_wire.py storage/test_leases.py)

WITH_TORCH := torch triton cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas \
	nvidia-cuda-cupti nvidia-cuda-nvrtc nvidia-cuda-runtime nvidia-cudnn-cu13 nvidia-cufft \
	nvidia-cufile nvidia-curand nvidia-cusolver nvidia-cusparse nvidia-cusparselt-cu13 \
	nvidia-nccl-cu13 nvidia-nvjitlink nvidia-nvshmem-cu13 nvidia-nvtx

.PHONY: demo check test kernels kernels-drawing kernels-learning kernels-physics test-slow system-packages sync lint lint-studio format schema coverage bench pins docs clean

demo: $(STAMP)
	$(BIN)/real2sim demo --out out/demo

check: lint
	$(PYTEST) $(PARALLEL) $(FAST)

test: sync
	$(PYTEST) $(PARALLEL)

# Compile the kernels that tests load from disk; make -j compiles the parts in parallel.
kernels: kernels-physics kernels-drawing kernels-learning

kernels-drawing kernels-learning kernels-physics: kernels-%: $(STAMP)
	$(BIN)/python scripts/compile_kernels.py $*

test-slow: $(STAMP)
	$(PYTEST) $(PARALLEL) --run-slow -m "slow or browser or gpu or ray"

# Programs that some tests start, from Debian's packages; where one is missing its tests skip.
system-packages:
	apt-get -qq update
	DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends \
	  chromium-headless-shell postgresql haproxy buildah debootstrap

# The sync client, from the async one.
sync: $(STAMP)
	$(BIN)/python client/hatch_build.py

lint: sync
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy -p real2sim_proto -p real2sim -p real2sim_server -p real2sim_bench

# The studio's JavaScript; needs Node.js 20.
lint-studio:
	npm ci --silent
	npm run --silent lint
	npm run --silent format:check

format: $(STAMP)
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

# The contract as files, in out/contract, and their hashes, which a test compares.
schema: $(STAMP)
	rm -rf out/contract
	$(BIN)/python -m real2sim_proto.schema out/contract/schema
	$(BIN)/python -c 'from real2sim_server.service.app import openapi_text; print(openapi_text(), end="")' > out/contract/openapi.json
	cd out/contract && sha256sum openapi.json schema/*.json > ../../proto/contract.sha256

coverage: $(STAMP)
	$(PYTEST) $(PARALLEL) --cov --cov-report=html:out/coverage --cov-report=term

# What an image installs, with hashes, from constraints.txt; and the notices that go with it. torch
# and what comes with it are apart: builds for CPU and CUDA differ.
pins: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip compile pyproject.toml --quiet --extra postgres \
	  --extra objects --extra tracing -c constraints.txt \
	  --generate-hashes --universal --python-version 3.11 --no-annotate --no-header --no-emit-package real2sim \
	  $(patsubst %,--no-emit-package %,$(WITH_TORCH)) -o docker/requirements.txt
	$(BIN)/python scripts/third_party.py

docs: $(STAMP)
	$(BIN)/python -m sphinx -q -W --keep-going -j auto -d out/doctrees docs site

bench: $(STAMP)
	$(BIN)/real2sim bench render --json out/bench_render.json
	$(BIN)/real2sim bench serve --json out/bench_serve.json

$(STAMP): pyproject.toml client/pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
	  -c constraints.txt -e client -e '.[dev,docs]'
	@touch $@

clean:
	rm -rf $(VENV) out build dist site
