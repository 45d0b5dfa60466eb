"""Benchmarks are run by hand: that they still find what they measure is asked of them with the tests."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.bench import bench_device, bench_viewfinder


@pytest.mark.parametrize("name", sorted(path.stem for path in Path(__file__).parent.glob("bench_*.py")))
def test_a_benchmark_finds_all_that_it_imports(name: str) -> None:
    if "torch" in name or "network" in name:
        pytest.importorskip("torch")
    import_module(f"tests.bench.{name}")


@pytest.mark.slow
def test_the_device_benchmark_writes_its_page_and_a_part_that_fails_hides_no_other(tmp_path: Path) -> None:
    """The first part is not there, the second is the smallest; each in a process of its own."""
    pytest.importorskip("torch")
    parts = "tests.bench.device.not_there,sweep"
    assert bench_device.main(["--out", str(tmp_path), "--parts", parts, "--commit", "abc"]) == 1
    page = json.loads((tmp_path / "device.json").read_text(encoding="utf-8"))
    failing, sweep = page["parts"]
    assert page["commit"] == "abc" and "ModuleNotFoundError" in failing["failed"] and failing["rows"] == []
    assert sweep["failed"] == "" and sweep["rows"][0]["device_ms"] > 0.0 and sweep["rows"][0]["psnr_db"] > 40.0
    text = (tmp_path / "device.md").read_text(encoding="utf-8")
    assert text.startswith(page["first_line"]) and "not_there" in text and "8 planes, 4 neighbours | 120 x 80" in text


def test_a_part_that_takes_too_long_keeps_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch")
    from tests.bench.device.rows import Row, Run

    def rows(run: Run) -> Iterator[Row]:
        yield Row("first", device_ms=1.0, bar_ms=2.0)
        while run.left_s < 60.0:
            time.sleep(0.01)

    monkeypatch.setitem(sys.modules, "endless", SimpleNamespace(rows=rows))
    monkeypatch.setitem(bench_device.PARTS, "endless", bench_device.Part("endless", 1.0, "without an end"))
    said: list[object] = []
    run = Run(torch.device("cpu"), False, time.monotonic() + 0.5, said.append)
    result = bench_device.run_part("endless", run, said.append)
    assert [row.met for row in result.rows] == [True] and "stopped" in result.failed


def test_the_viewfinder_benchmark_says_nothing_of_a_run_that_says_nothing() -> None:
    assert bench_viewfinder.refusal([7.0, 8.0], 0.05, 0) is None
    for draws_per_s, others, compiled, word in (([9.0], 0.3, 0, "30 % of a core"), ([], 0.0, 0, "never"), ([30.0], 0.0, 2, "2 kernels")):
        assert word in str(bench_viewfinder.refusal(draws_per_s, others, compiled))


def test_what_another_program_takes_of_the_machine_is_seen_and_the_viewers_are_not_taken_for_it() -> None:
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as spinning:
        counted, not_counted = bench_viewfinder.Spent(), bench_viewfinder.Spent()
        not_counted.begin(spinning.pid)
        counted.begin(os.getpid())
        time.sleep(0.5)
        counted.end()
        not_counted.end()
        spinning.kill()
    assert counted.others - not_counted.others > 0.2


def test_outcomes_are_read_of_what_pytest_prints_alone_and_with_several_workers() -> None:
    pytest.importorskip("torch")
    from tests.bench.device.device_tests import failures_of, outcomes_of

    alone = "tests/a/test_b.py::test_c[PASSED by] FAILED  [ 50%]\ntests/a/test_b.py::test_d SKIPPED (no GPU)  [100%]\n"
    summary = "=== short test summary info ===\nFAILED tests/a/test_b.py::test_c[PASSED by] - AssertionError: 1 - 2\n=== 1 failed ==="
    assert outcomes_of(alone + "[gw0] [ 50%] PASSED tests/a/test_b.py::test_e \n" + summary) == {
        "tests/a/test_b.py": {"FAILED": 1, "SKIPPED": 1, "PASSED": 1}
    }
    assert failures_of(summary) == [("failed: tests/a/test_b.py::test_c[PASSED by]", "AssertionError: 1 - 2")]
