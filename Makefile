# Two commands: `make demo` and `make test`. Both make .venv first (uv where installed, else venv
# and pip) and install the package with what the tests need.

PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
WORKERS ?= 2

# Many small matrices: one BLAS thread a process.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test lint bench install clean

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	@if command -v uv >/dev/null 2>&1; then \
	  uv venv --quiet --allow-existing --python $(PYTHON) $(VENV) && \
	  uv pip install --quiet --python $(BIN)/python -e '.[tests]'; \
	else \
	  $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[tests]'; \
	fi
	@touch $@

demo: install
	$(BIN)/jaxbundle adjust examples/convergent4/project.toml --out out/convergent4

test: install
	$(BIN)/python -m ruff check jaxbundle tests benchmarks
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup

bench: install
	$(BIN)/python benchmarks/big_block.py
	$(BIN)/python benchmarks/calibration.py
	$(BIN)/python benchmarks/bal.py --street 100 10000 --arc 40 10000 --baseline

clean:
	rm -rf $(VENV) out
