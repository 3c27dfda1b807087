# `make demo`, `make test` (`make test-further`: the further cases of its dear tests, `make test-all`: both), `make types`,
# `make test-commands`,
# `make test-oldest`, `make test-newest`, `make docs` and `make bench` (or a part of it, below). All make .venv first (uv where
# installed, else venv and pip) and install the package: `demo` with plots, the others with what the tests
# need; `docs` also Sphinx, `bench` also what it compares with; `test-oldest` and `test-newest` have
# environments of their own.
# More problems: make bench-bal BAL="problem-16-22106-pre.txt.bz2 …" PEERS="--ceres …"

PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
WORKERS ?= 2

# Many small matrices: one BLAS thread a process.
export OPENBLAS_NUM_THREADS ?= 1

BOUNDS = oldest newest
BENCHES = block batch bal first
MORE_BENCHES = large pushbroom orientation measuring blunders
BAL ?=
PEERS ?=

.PHONY: demo test types test-further test-all test-commands random-problems mutants mutations bench docs install install-demo \
  install-docs clean \
  bench-gpu $(BOUNDS:%=install-%) $(BOUNDS:%=test-%) $(BENCHES:%=bench-%) $(MORE_BENCHES:%=bench-%)

# An extra of the package beside what the tests need.
define install_extra
if command -v uv >/dev/null 2>&1; then uv pip install --quiet --python $(BIN)/python -e '.[$(1)]'; \
else $(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(1)]'; fi
endef

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	@echo "Installing jaxbundle and what its tests need into $(VENV): 1.9 GB, some minutes the first time"
	@if command -v uv >/dev/null 2>&1; then \
	  uv venv --quiet --allow-existing --python $(PYTHON) $(VENV) && \
	  uv pip install --quiet --python $(BIN)/python -e '.[tests]'; \
	else \
	  $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[tests]'; \
	fi
	@touch $@

demo: install-demo
	@echo "Adjusting examples/convergent4; report, tables, plots and a page go to out/convergent4"
	$(BIN)/jaxbundle adjust examples/convergent4/project.toml --out out/convergent4

# What `make install` has installed suffices.
install-demo:
	@test $(VENV)/installed -nt pyproject.toml || $(MAKE) --no-print-directory $(VENV)/installed-demo

$(VENV)/installed-demo: pyproject.toml
	@echo "Installing jaxbundle with plots and tables into $(VENV): 35 packages, 0.75 GB"
	@if command -v uv >/dev/null 2>&1; then \
	  uv venv --quiet --allow-existing --python $(PYTHON) $(VENV) && \
	  uv pip install --python $(BIN)/python -e '.[plots,tables]'; \
	else \
	  $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip install --disable-pip-version-check -e '.[plots,tables]'; \
	fi
	@touch $@

# The types of names that are imported on first use.
stubs:
	$(BIN)/python tests/stubs.py

test: CASES = -m 'not further'
test-further: CASES = -m further --maxfail 20
test test-further test-all: install
	$(BIN)/python -m ruff check jaxbundle tests benchmarks docs
	$(BIN)/python -m ruff format --check --quiet jaxbundle
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile $(CASES)

# The types of the whole package: a minute and a half.
types: install
	$(BIN)/basedpyright --pythonpath $(BIN)/python

# Commands and Python blocks of README and docs, and commands on every camera model, as processes from a
# clone with an empty home, cold and warm: an hour on two cores, or as much as fits: make test-commands SECONDS=500
test-commands: install
	$(BIN)/python tests/processes/run.py $(if $(SECONDS),--seconds $(SECONDS)) $(if $(PAGES),--pages $(PAGES))

# 500 random problems by the engine and by dense algebra, in WORKERS processes; 40 of them are in `make test`.
random-problems: install
	cd tests/leastsquares && seq 0 $$(($(WORKERS) - 1)) | \
	  xargs -P $(WORKERS) -I{} ../../$(BIN)/python test_random_problems.py 500 {} $(WORKERS)

# CASES_EACH damaged inputs of every reader, in WORKERS processes that may be killed (60 s, 3 GB a case); the first
# 20 of each are in `make test`, 300 in `make test-all`. Another SEED damages them otherwise.
CASES_EACH ?= 300
SEED ?= 37
mutations: install
	$(BIN)/python tests/mutate_inputs.py $(CASES_EACH) --seed $(SEED) --workers $(WORKERS)

# 300 changes of the package, 10 s each, with the single tests that execute the changed line, which the
# first call finds in an hour; resumes. Those that survived, once more: python tests/mutants.py --again.
mutants: $(VENV)/mutated
	$(BIN)/python tests/mutants.py

$(VENV)/mutated: $(VENV)/installed
	@$(call install_extra,mutants)
	@touch $@

# Some tests with the oldest versions that pyproject.toml allows, and with the newest ones on another
# Python (make test-newest PYTHON=python3.13), each in an environment of its own: what depends on them,
# commands as processes, and the times of a first and a second process.
SOME = tests/test_saved.py tests/test_float64.py tests/test_programs.py tests/cli/test_first_touch.py \
  tests/cli/test_terminals.py tests/adjustment/test_solve.py

out/oldest/installed: VERSIONS = -c out/oldest/versions.txt
$(BOUNDS:%=out/%/installed): out/%/installed: pyproject.toml
	$(PYTHON) -m venv --clear out/$*
	$(PYTHON) tests/oldest_versions.py > out/$*/versions.txt
	out/$*/bin/python -m pip install --quiet --disable-pip-version-check $(VERSIONS) \
	  ".[tables]" pytest beartype hypothesis
	@touch $@

$(BOUNDS:%=install-%): install-%: out/%/installed

$(BOUNDS:%=test-%): test-%: install-%
	out/$*/bin/python -m jaxbundle --version
	out/$*/bin/python -m pytest -q -p no:cacheprovider $(SOME) -W ignore::DeprecationWarning
	out/$*/bin/python benchmarks/first.py --repeat 1

$(VENV)/documented: $(VENV)/installed
	@$(call install_extra,docs)
	@touch $@

install-docs: $(VENV)/documented

# The site, in out/docs; a warning, such as of a link that leads nowhere, is an error.
docs: install-docs
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going -c docs . out/docs
	@echo "out/docs/index.html"

$(VENV)/compared: $(VENV)/installed
	@$(call install_extra,bench) || echo "the extra 'bench' could not be installed: peers that are missing will be skipped"
	@touch $@

bench: $(BENCHES:%=bench-%)

bench-block: $(VENV)/compared
	$(BIN)/python benchmarks/big_block.py

bench-batch: $(VENV)/compared
	$(BIN)/python benchmarks/calibration.py

bench-bal: $(VENV)/compared
	$(BIN)/python benchmarks/bal.py $(BAL) --street 100 10000 --arc 40 10000 --baseline $(PEERS)

bench-first: $(VENV)/compared
	$(BIN)/python benchmarks/first.py

# Large problems, once each; the block with its statistics needs 3.5 GB.
bench-large: ONCE = --rounds 1 --repeat 1 --evaluations 60 --peers pycolmap ceres
bench-large: $(VENV)/compared
	$(BIN)/python benchmarks/big_block.py --images 1000 --points 310000 --spacing 0.79 --repeat 1
	$(BIN)/python benchmarks/bal.py --street 1723 156502 --solver sparse_schur $(ONCE) $(PEERS)
	$(BIN)/python benchmarks/bal.py --arc 356 226730 --solver iterative_schur $(ONCE) $(PEERS)

bench-pushbroom bench-orientation bench-measuring bench-blunders bench-design: bench-%: $(VENV)/compared
	$(BIN)/python benchmarks/$*.py

# On the GPU of this machine and on its processor, in at most eight minutes, with the Python, JAX, equinox,
# optimistix, lineax and scipy that are there (nothing is installed); BAL problems: make bench-gpu BAL=folder
bench-gpu:
	PYTHONPATH=.:$(PYTHONPATH) $(PYTHON) benchmarks/gpu.py $(if $(BAL),--bal $(BAL)) $(if $(OUT),--json $(OUT)/gpu.json)

clean:
	rm -rf $(VENV) out
