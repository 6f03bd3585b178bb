# Needs Python 3.11 or newer, pip and make; everything else goes into .venv.
PYTHON ?= $(firstword $(foreach p,python3 python python3.14 python3.13 python3.12 python3.11,\
	$(shell $(p) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(p))))
BIN := .venv/bin
# A file runs in one worker; in the order of their names, because few tests of a file may take as long as many.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder
# Stamps in one environment: what the package needs to run, and what its development needs besides.
RUNTIME := .venv/.runtime
ENVIRONMENT := .venv/.installed
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e

.PHONY: demo test quick acceptance fuzz lint bench docs docs-printed docs-figures coverage lock clean

demo: $(RUNTIME)  ## fly, identify, fly what was identified; writes out/demo/report.html and flight.png
	$(BIN)/python examples/demo.py

test: lint docs  ## everything that must hold, but for records that take more than 15 s of a processor
	$(BIN)/pytest -q $(PARALLEL) -m "not long"

quick: $(ENVIRONMENT)  ## tests without the slow ones
	$(BIN)/pytest -q $(PARALLEL) -m "not slow"

acceptance: $(ENVIRONMENT)  ## twenty logs and random machines, with the records that take long
	$(BIN)/pytest -q -rx $(PARALLEL) tests/acceptance

# Others every time; FUZZ_EXAMPLES files of each kind.
FUZZ_EXAMPLES ?= 200
fuzz: $(ENVIRONMENT)  ## damaged files of every kind, and entries of the cache of machine code
	FUZZ_EXAMPLES=$(FUZZ_EXAMPLES) $(BIN)/pytest -q -s tests/test_fuzz.py tests/test_code_cache.py tests/test_hostile_logs.py \
		-k "damaged_file or changed_byte or hostile_logs"

lint: $(ENVIRONMENT)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

bench: $(ENVIRONMENT)  ## measured figures; each benchmark prints its table
	@set -e; for file in benchmarks/*.py; do echo "== $$file"; $(BIN)/python "$$file"; done

docs: $(ENVIRONMENT)  ## the pages; --quiet would let warnings pass
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir out/site

docs-printed: $(ENVIRONMENT)  ## what commands of the pages print today, written into the pages; a minute
	RENEW_PAGES=1 $(BIN)/pytest -q $(PARALLEL) tests/test_documentation.py -k runs_as_it_is_shown

docs-figures: $(ENVIRONMENT)  ## every command behind a number of the pages that has no output yet, compared with it; many hours
	$(BIN)/python benchmarks/documented.py --run

coverage: $(ENVIRONMENT)
	$(BIN)/pytest -q -m "not long" --cov --cov-report=term

lock: $(ENVIRONMENT)  ## pin every dependency anew
	$(BIN)/pip-compile --quiet --extra dev --strip-extras --upgrade --no-emit-index-url --no-emit-trusted-host \
		--no-emit-find-links --no-annotate --no-header --output-file requirements.lock pyproject.toml

clean:
	rm -rf .venv out dist build .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis .coverage

# A stamp is written last: an installation that was interrupted is tried again.
$(RUNTIME): pyproject.toml requirements.lock | $(BIN)/python
	$(INSTALL) .
	@touch $@

$(ENVIRONMENT): $(RUNTIME)
	$(INSTALL) ".[dev]"
	@touch $@

# A Python without ensurepip (a distribution's, without its venv package) lends the environment its own pip.
$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed and none was found; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then $(PYTHON) -m venv .venv; \
	else $(PYTHON) -m venv --without-pip .venv && $(PYTHON) -m pip --python $@ install --quiet pip; fi
