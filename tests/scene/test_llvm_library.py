"""LLVM's library for Mitsuba: a tested or new enough one is found; old ones, which abort the process, are refused in a sentence."""

from pathlib import Path

import pytest

from mrbokeh.scene.mitsuba import mitsuba_tracer
from tests.support.refusals import refused


@pytest.mark.parametrize(
    ("there", "found"),
    [
        ((), None),
        (("libLLVM-14.so.1", "libLLVM-15.so.1"), None),
        (("libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVM.so.18.1"), "libLLVM.so.18.1"),
        (("libLLVM.so.19.1", "libLLVM.so.20.1"), "libLLVM.so.19.1"),
    ],
)
def test_the_library_that_can_be_used(there: tuple[str, ...], found: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(mitsuba_tracer, "_PLACES", (str(tmp_path),))
    for name in there:
        (tmp_path / name).touch()
    library = mitsuba_tracer.find_llvm()
    assert (library and library.name) == found
    if there and found is None:
        refused(r"abort.*apt install libllvm19", mitsuba_tracer.load)
