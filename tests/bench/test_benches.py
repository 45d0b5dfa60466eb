"""Benchmarks are run by hand: that they still find what they measure is asked of them with the tests."""

from importlib import import_module
from pathlib import Path

import pytest


@pytest.mark.parametrize("name", sorted(path.stem for path in Path(__file__).parent.glob("bench_*.py")))
def test_a_benchmark_finds_all_that_it_imports(name: str) -> None:
    if "torch" in name or "network" in name:
        pytest.importorskip("torch")
    import_module(f"tests.bench.{name}")
