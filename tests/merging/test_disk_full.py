"""A full disk is one clear line; finished slices stay, and no half file."""

import errno
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import mrbokeh.images.camera_rgb
import mrbokeh.images.exr_io
from capture.stacks.ingest import ingest
from capture.stacks.slice_files import DiskFullError, find_slices, reporting_full_disk
from mrbokeh.images.exr_io import ExrPart
from mrbokeh.images.image_io import write_image
from mrbokeh.system.atomic_files import atomic_path
from tests.support.made_photographs import make_shoot


@pytest.fixture
def shoot(tmp_path: Path) -> Path:
    return make_shoot(tmp_path / "shoot")


def test_a_full_disk_is_one_clear_line_and_finished_slices_stay(shoot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The third slice finds no space halfway; the next run, with space, makes only what is missing."""
    written: list[Path] = []
    real_write = mrbokeh.images.exr_io.write_exr

    def write_until_full(path: Path, part: ExrPart) -> None:
        if len(written) == 2:
            with atomic_path(path) as temporary:
                temporary.write_bytes(b"half a file")
                raise RuntimeError(f'Failed to write pixel data to image file "{temporary}". No space left on device.')
        written.append(path)
        real_write(path, part)

    with monkeypatch.context() as patch:
        patch.setattr(mrbokeh.images.camera_rgb, "write_exr", write_until_full)
        with pytest.raises(DiskFullError, match=r"is full \(\d+ MiB left\): make room .* finished slices are kept"):
            ingest([shoot], tmp_path / "scene")
    folder = tmp_path / "scene" / "shoot"
    assert len(find_slices(folder)) == len(list((folder / "slices").iterdir())) == 2, "no half file"
    assert not (folder / "stack.json").exists()
    assert ingest([shoot], tmp_path / "scene").stacks[0].kept == 2


def test_a_full_disk_is_told_from_other_errors(tmp_path: Path) -> None:
    for error in (OSError(errno.ENOSPC, "No space left on device"), OSError(errno.EDQUOT, "quota"), RuntimeError("write failed")):
        with pytest.raises(DiskFullError), reporting_full_disk(tmp_path / "a.exr", needed_bytes=2**80):
            raise error
    with pytest.raises(PermissionError), reporting_full_disk(tmp_path / "a.exr"):
        raise PermissionError(errno.EACCES, "no")
    with pytest.raises(RuntimeError, match="something else"), reporting_full_disk(tmp_path / "a.exr"):
        raise RuntimeError("something else")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can make a small disk")
def test_a_disk_that_is_really_full(tmp_path: Path) -> None:
    """One MiB for a slice of three."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True).returncode != 0:
        pytest.skip("this machine does not let tests mount a small disk")
    try:
        write_image(tmp_path / "0.exr", np.random.default_rng(0).random((600, 800, 3)).astype(np.float32), half=False)
        with pytest.raises(DiskFullError):
            ingest([tmp_path / "0.exr"], disk / "scene")
        assert not list(disk.rglob("*.exr")) and not list(disk.rglob("stack.json"))
    finally:
        subprocess.run(["umount", str(disk)], check=True)
