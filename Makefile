# Everything sets itself up: a virtual environment in .venv with the tested versions of constraints.txt.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
READY := $(VENV)/.installed
OUT ?= demo_out

.PHONY: demo gallery docs test test-slow test-browser check bench gpu wheel clean

demo: $(READY)
	$(RUN)/mrbokeh demo --out $(OUT)

gallery: $(READY)
	$(RUN)/mrbokeh demo --out $(OUT)
	$(RUN)/python -m datasets_scripts.gallery gallery_out --demo $(OUT)

# Pages of the whole checkout, so that their links are those of the forge; docs_out/index.html leads to the map.
docs: $(READY)
	$(RUN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	$(RUN)/python -m sphinx --fail-on-warning --keep-going --quiet --conf-dir docs . docs_out
	echo '<meta http-equiv="refresh" content="0; url=docs/index.html">' > docs_out/index.html

# Workers and many processes start from the same sources: what Python compiles of them is kept, whatever the environment says. Three workers for
# two cores: a seventh of the time a worker waits for a page, a camera or a process of its own.
test: export PYTHONDONTWRITEBYTECODE =
test: $(READY)
	$(RUN)/python -m pytest -n 3 --dist worksteal -m "not slow" --durations 30 --durations-min 1

test-slow: $(READY)
	$(RUN)/python -m pip install --quiet --constraint constraints.txt --editable ".[all,dev,datasets,docs]"
	$(RUN)/python -m pytest -m slow

test-browser: $(READY)
	command -v chromium chromium-browser google-chrome > /dev/null || apt-get install --yes chromium
	$(RUN)/python -m pytest -m browser

check: $(READY)
	$(RUN)/ruff format --check .
	$(RUN)/ruff check .
	$(RUN)/mypy
	$(MAKE) test

# Those that bring what they measure; the others want folders, bench_device is `make gpu`.
WANTING := device real pixel4 photographs views_depth mended_depth
bench: $(READY)
	$(RUN)/python -m pip install --quiet --constraint constraints.txt --editable ".[all,dev,mitsuba]"
	for bench in $(filter-out $(WANTING:%=tests/bench/bench_%.py),$(wildcard tests/bench/bench_*.py)); do \
		echo "== $$(date +%T) $$bench"; $(RUN)/python -m tests.bench.$$(basename $$bench .py) || exit 1; done

# What runs on an NVIDIA GPU, measured and tested in less than 8 minutes: bench_out/device/device.md. Without one the processor stands in.
gpu: $(READY)
	$(RUN)/python -m tests.bench.bench_device

# The committed files with kernels compiled for x86-64 with AVX2: commands begin at once where it is installed, with this Python and the numba
# and numpy of constraints.txt.
wheel: PORTABLE = NUMBA_CPU_NAME=x86-64-v3 NUMBA_CPU_FEATURES= NUMBA_CACHE_DIR="$(CURDIR)/build/wheel/kernels"
wheel: $(READY)
	rm -rf build/wheel && mkdir -p build/wheel/source dist
	git archive HEAD | tar -x -C build/wheel/source
	cd build/wheel && PYTHONPATH="$(CURDIR)/build/wheel/source" $(PORTABLE) "$(CURDIR)/$(RUN)/python" -m mrbokeh.cli doctor --compile
	mv build/wheel/kernels/mrbokeh build/wheel/source/mrbokeh/compiled_kernels
	find build/wheel/source/mrbokeh/compiled_kernels -name "*.lock" -delete
	$(RUN)/python -m build --wheel build/wheel/source --outdir dist \
		-C--build-option=--plat-name=$$($(RUN)/python -c "import sysconfig; print(sysconfig.get_platform())") \
		-C--build-option=--python-tag=$$($(RUN)/python -c "import sys; print('cp%d%d' % sys.version_info[:2])")

# A fifth of what packages bring, tests of their own among it.
SELDOM_IMPORTED := /(tests|pip|setuptools|mypy|mypyc|_inductor|sympy/physics)/|/py312_
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN)/python -m pip install --quiet --upgrade pip
	$(RUN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[all,dev]"
	-$(RUN)/python -m compileall -qq -j 0 -x '$(SELDOM_IMPORTED)' $(VENV)/lib  # what pip does on one core
	touch $@

clean:
	rm -rf $(VENV) build dist docs_out *.egg-info .pytest_cache .mypy_cache .ruff_cache
