"""The wheel: what is in it, and that its commands run outside the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from mrbokeh.optics.lens_library import names as library_names

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = ("capture", "train", "lens", "render", "composite", "video", "viewfinder", "demo", "doctor")

HELP_OF_ALL = """
import sys

site, *commands = sys.argv[1:]
codes = []
for command in commands:
    for name in [each for each in sys.modules if each.partition(".")[0] in ("mrbokeh", "capture", "training", "viewfinder")]:
        del sys.modules[name]
    from mrbokeh.cli import main
    assert sys.modules["mrbokeh"].__file__.startswith(site)
    sys.argv = ["mrbokeh", command, "--help"]
    try:
        main()
    except SystemExit as stop:
        codes.append(stop.code)
print(*codes, end=" \\n")
"""
"""Each imports all modules of the wheel that it needs anew, so that none lives on what another imported."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(out)], cwd=_copy(out), check=True, capture_output=True, text=True)
    return next(out.glob("mrbokeh-*.whl"))


def _copy(out: Path) -> Path:
    """The files under version control only, so that neither build folders nor local rests get into the wheel."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    source = out / "source"
    for name in filter(None, listed):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    return source


def test_data_travels_with_its_licences(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"mrbokeh", "capture", "training", "viewfinder"}
    assert "mrbokeh/py.typed" in names
    assert {f"mrbokeh/demo_data/{folder}/LICENSE.txt" for folder in ("raw_stack", "pcb_oblique", "objects")} <= names
    assert {f"mrbokeh/demo_data/raw_stack/view_{v}/slice_{i:02d}.dng" for v in range(3) for i in range(9)} <= names
    assert {f"mrbokeh/lens_data/{each}.json" for each in library_names()} <= names and len(library_names()) >= 10
    assert any(name.startswith("viewfinder/page/") for name in names) and wheel.stat().st_size < 20e6


def test_every_command_runs_from_the_installed_wheel(wheel: Path, tmp_path: Path) -> None:
    """Unpacked, in another folder, with the libraries of this environment but not the checkout; pip makes `mrbokeh` of the entry point."""
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(site)
    assert "mrbokeh = mrbokeh.cli:main" in next(site.glob("*.dist-info/entry_points.txt")).read_text()
    environment = os.environ | {"PYTHONPATH": str(site), "PYTHONSAFEPATH": "1", "NO_COLOR": "1"}
    command = [sys.executable, "-c", HELP_OF_ALL, str(site), *COMMANDS]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[-2] == "0 " * len(COMMANDS), done.stderr
    assert all(f"Usage: mrbokeh {name} " in done.stdout for name in COMMANDS)


@pytest.mark.slow
def test_pip_builds_and_installs_it_with_its_data_and_its_command(wheel: Path, tmp_path: Path) -> None:
    """What pip lays down is what setuptools packed, and `mrbokeh` starts from there."""
    pip, site = [sys.executable, "-m", "pip", "--quiet"], tmp_path / "site"
    built = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path), str(wheel.parent / "source")]
    subprocess.run(built, check=True, capture_output=True)
    [by_pip] = tmp_path.glob("mrbokeh-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(by_pip)], check=True, capture_output=True)
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed <= {path.relative_to(site).as_posix() for path in site.rglob("*")}
    command = [str(site / "bin" / "mrbokeh"), "--help"]
    done = subprocess.run(command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True)
    assert done.returncode == 0 and "Usage: mrbokeh" in done.stdout, done.stderr
