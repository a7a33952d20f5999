# magcal: every target sets up what it needs, so that it can be the first command on a fresh machine.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
KERNELS := $(VENV)/.kernels

# Where the environment forbids to keep bytecode, each of the hundreds of processes that tests start compiles magcal anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help system install demo test test-quick check format bench studies mutations pictures docs faults lock audit clean

help:            ## this list
	@grep -hE '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## */\t/' | expand -t 12

system:          ## the system packages that the tests need, where they are not: a Chromium, strace, a C compiler
	@wanted=; \
	command -v chromium chromium-browser google-chrome >/dev/null || wanted="chromium fonts-dejavu-core"; \
	command -v strace >/dev/null || wanted="$$wanted strace"; \
	command -v cc gcc >/dev/null || wanted="$$wanted gcc libc6-dev"; \
	if [ -n "$$wanted" ]; then \
	  echo "installing $$wanted (a real browser, what a power loss would leave, flight software)"; \
	  as_root=$$([ "$$(id -u)" = 0 ] || echo sudo); \
	  $$as_root apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive $$as_root apt-get install -y -qq --no-install-recommends $$wanted >/dev/null; \
	fi

$(STAMP): requirements/dev.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $(STAMP)

# A cached kernel is kept while its own file is unchanged, also where a kernel that it contains is not: one change, and
# all are compiled anew.
$(KERNELS): $(STAMP) $(shell grep -rl --include='*.py' njit magcal_core)
	@find magcal_core -name '*.nb[ci]' -delete
	@$(BIN)/python -m magcal_core.compile_kernels
	@touch $(KERNELS)

install: $(KERNELS) ## a virtual environment in .venv with magcal and its tools

demo: $(KERNELS)  ## a whole mission on this machine; ONCE=1 ends after the result
	$(BIN)/magcal demo $(if $(ONCE),--once) $(if $(PORT),--port $(PORT))

check: $(STAMP)   ## format, lint, types, imports
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

format: $(STAMP)  ## let ruff rewrite what it can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test: system check $(KERNELS) ## the checks and every test
	$(BIN)/python -m pytest $(if $(PYTEST_ARGS),$(PYTEST_ARGS),-n 3 --dist loadfile --no-loadscope-reorder)

test-quick: $(KERNELS) ## what a change needs while one works on it: no browser, no PostgreSQL, no killed process
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "not slow and not postgres and not browser and not real_data" \
	  --ignore tests/faults --ignore tests/browser

faults: $(KERNELS) ## kill, pause and fill real processes; MAGCAL_FAULT_TRIALS=N for more of it
	$(BIN)/python -m pytest tests/faults

bench: $(KERNELS) ## measure against peers and bare kernels; writes benchmarks/results/
	$(BIN)/python -m benchmarks

studies: $(KERNELS) ## count errors of estimates and verdicts over thousands of simulated missions; an hour or two
	$(BIN)/python -m benchmarks --studies

mutations: $(KERNELS) ## plant single faults in a copy and see whether the tests notice; FAULTS="a b" for some
	$(BIN)/python tests/mutations.py $(FAULTS)

pictures: system $(KERNELS) ## every page of the dashboard, light and dark, wide and narrow, in artefacts/pages-of-a-mission/
	$(BIN)/python -m tests.browser.pictures artefacts/pages-of-a-mission

docs: $(STAMP)    ## the documentation as web pages in site/
	$(BIN)/mkdocs build --strict --quiet

lock:             ## resolve the dependencies anew (needs uv)
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links \
	  --no-header --no-annotate --extra dev pyproject.toml -o requirements/dev.txt
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links \
	  --no-header --no-annotate -c requirements/dev.txt pyproject.toml -o requirements/run.txt

audit:           ## ask the advisory databases about every locked dependency (needs the network)
	$(PYTHON) -m venv $(VENV)/audit
	$(VENV)/audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(VENV)/audit/bin/pip-audit --strict --disable-pip --require-hashes --requirement requirements/dev.txt

clean:            ## everything that can be made again
	rm -rf $(VENV) site build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
