# Every target sets up what it needs: .venv with the locked packages and this project, editable.
# A warm run only compares time stamps.  PYTHON=/path/to/python3.12 chooses the interpreter.

PYTHON ?= python3
PIP = .venv/bin/python -m pip --disable-pip-version-check
READY = .venv/.ready

.PHONY: demo check test long wheel bench speed benchmark-missing lint campaign faults fuzz soak mutants paper pictures screenshots lock clean

demo: $(READY)
	.venv/bin/rtid demo

# Three on two cores: what waits for a browser or a process leaves one idle; a fourth gains nothing.
# Bytecode is kept whatever the environment says: the tests start hundreds of interpreters.
test: export PYTHONDONTWRITEBYTECODE =
test: $(READY)
	.venv/bin/python -m pytest -q -n 3 --dist loadfile --no-loadscope-reorder -p no:benchmark -p tools.spent

# One more case, or a whole way, of what `make test` holds: whole records that are diagnosed for tens of seconds.
long: $(READY)
	.venv/bin/python -m pytest -q -n 3 --dist worksteal -p no:benchmark -p tools.spent -m long

# After each edit, a minute: lint, types, layers, and the unit tests that the change touches, nearest
# first; all unit tests: make check ALL=1.
check: $(READY)
	.venv/bin/python -m tools.check $(if $(ALL),--all)

# The wheel with its kernels compiled for a family of processors, tried in another folder, into out/.
wheel: $(READY)
	.venv/bin/python -m tools.wheel out

bench: $(READY)
	@mkdir -p out
	.venv/bin/python -m pytest -q -s benchmarks --benchmark-json=out/bench.json
	.venv/bin/python -m benchmarks.table

# The part of it that has gates, wide ones: a factor that is lost is seen (a minute or two).
speed: $(READY)
	ROUNDS=1 .venv/bin/python -m pytest -q benchmarks/test_update.py benchmarks/test_commands.py \
	  -k "not cold and not libraries and not same_sums"

# Ours beside a dozen other methods, on the same records, into docs/benchmark.md: 40 minutes on a core of its own.
# A second seed, on other simulators' machines, says whether the order of the methods holds.
benchmark-missing: $(READY)
	@$(PIP) install -qq --no-deps -r requirements-benchmark.lock
	.venv/bin/python -m benchmarks.missing --seed 2026
	.venv/bin/python -m benchmarks.missing --seed 2027 --plants exudyn_rig,modelica_rig
	.venv/bin/python -m benchmarks.missing.page out/missing/2026/result.json out/missing/2027/result.json

lint: $(READY)
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/mypy

campaign: $(READY)
	@mkdir -p out
	.venv/bin/python -m pytest -q -s -p no:benchmark -m campaign tests; \
	  status=$$?; .venv/bin/python -m tests.campaign.report && exit $$status

# Every view of the workbench on the demo's worn machine, light and dark, into out/screenshots.
screenshots: $(READY)
	.venv/bin/python -m tools.screenshots out/screenshots

# All 40 faults with their figures: a table in out/faults.md; what takes longer is in `make soak`,
# whose figures, of the last time it ran here, stand in the same table.
# It ends with an error where a row has missed its figure, or did not run.
faults: $(READY)
	@mkdir -p out && rm -f out/faults.jsonl
	RTID_FAULTS=$(CURDIR)/out/faults.jsonl .venv/bin/python -m pytest -q -p no:benchmark \
	  -m 'not campaign and not soak and not long' tests/faults $$(.venv/bin/python -m tests.faults.elsewhere); \
	  status=$$?; .venv/bin/python -m tests.faults.table out/faults.jsonl out/soak.jsonl --all > out/faults.md || status=1; \
	  cat out/faults.md; exit $$status

# Mutated projects, DBCs, EDS, logs, tables and plant files, 500 of each format, each through its
# command (an hour): make fuzz SEED=2 FUZZ="--logs 500 --dbcs 0"; one case again: --case logs-17
SEED ?= 1
FUZZ ?= --projects 500 --dbcs 500 --nodes 500 --logs 5000 --tables 3000 --plants 200 --bombs 8
fuzz: $(READY)
	@rm -rf out/fuzz && mkdir -p out
	.venv/bin/python -m tests.fuzz --seed $(SEED) --out out/fuzz $(FUZZ)

# The long ones (an hour): a full bus, 50 kills, hours in minutes, live diagnoses, an open page.
soak: $(READY)
	@mkdir -p out && rm -f out/soak.jsonl
	RTID_FAULTS=$(CURDIR)/out/soak.jsonl .venv/bin/python -m pytest -q -p no:benchmark -m soak tests/faults tests/browser; \
	  status=$$?; .venv/bin/python -m tests.faults.table out/soak.jsonl | tee out/soak.md; \
	  exit $$status

# Change one operator of the gates at a time: some test must fail (by hand; tests/gates/mutants.txt).
mutants: $(READY)
	.venv/bin/python -m tools.mutate

# Every figure and table of the paper, into out/paper (half an hour), and the pictures of docs/paper.md;
# it ends with 4 where a goal is missed.
paper: $(READY)
	.venv/bin/python -m benchmarks.paper --out out/paper; status=$$?; \
	  .venv/bin/python -m tools.paper_pictures out/paper tools/pictures && exit $$status

# The pictures of README and docs/tools.md; the first one is the page's, as `make screenshots` takes it.
pictures: $(READY)
	.venv/bin/python -m tools.readme_pictures tools/pictures
	.venv/bin/python -m tools.tool_pictures tools/pictures
	.venv/bin/python -m tools.screenshots out/screenshots tools/pictures

# The lock names all that is needed, so that two installers share it and no one asks what depends
# on what: half the time of one after the other.  What is editable no installer compiles, nor, where
# PYTHONDONTWRITEBYTECODE is set, does any command, each of which then took half a second for it.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "rtid needs Python 3.11 or newer, and $(PYTHON) is not:" \
	       "run make again with PYTHON=/path/to/python3.12"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "$(PYTHON) cannot make virtual environments: install its venv package" \
	       "(Debian: apt install python3-venv)"; exit 1; }
	@echo "Setting up .venv (once; about a minute) ..."
	@$(PYTHON) -m venv --clear .venv
	@xargs -P 2 -n 16 $(PIP) install -qq --no-deps <requirements.lock
	@$(PIP) install -qq --no-deps --no-build-isolation --editable .
	@.venv/bin/python -m compileall -q rtid firmware_bridge
	@touch $@

# The newest versions that pyproject.toml admits, for the core and [dev].
lock:
	$(PYTHON) -m venv --clear .venv
	$(PIP) install --upgrade ".[dev]"
	$(PIP) uninstall --yes rtid
	$(PIP) freeze --all --exclude pip > requirements.lock

clean:
	rm -rf .venv build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .benchmarks
	find . -name __pycache__ -prune -exec rm -rf {} +
