"""Who may import whom (ARCHITECTURE.md), read from the syntax tree; imports inside functions count like any other."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.project.test_style import FILES, PACKAGES, ROOT, nodes

# The levels of mrbokeh/, top first: a folder imports from lower levels only; inside a folder anything without a cycle.
LEVELS = (
    {"cli"},
    {"commands"},
    {"shots"},
    {"compositing", "refocus", "demo"},
    {"scene", "depth", "checks", "figures", "lens_measuring", "hosts"},
    {"renderers", "stacks", "distortion"},
    {"layering", "psf_models", "tracking", "solving"},
    {"optics", "video"},
    {"images"},
    {"system"},
)
# Those of mrbokeh/renderers: what chooses one; the methods, which never import one another; kernels of banks; fitted kernels; the protocol.
RENDERER_LEVELS = (
    {"choose"},
    {"polygon", "low_rank", "spreadlets", "layered_reconstruction", "onnx_network", "scatter_reference"},
    {"bank"},
    {"kernels"},
    {"base", "onnx_sessions"},
)


def modules() -> dict[str, Path]:
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in FILES}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


MODULES = modules()


@cache
def imports() -> dict[Path, list[ast.Import | ast.ImportFrom]]:
    """Every import statement of each file, also those within functions."""
    found: dict[Path, list[ast.Import | ast.ImportFrom]] = {path: [] for path in MODULES.values()}
    for path, node in nodes():
        if isinstance(node, ast.Import | ast.ImportFrom):
            found[path].append(node)
    return found


def imported(path: Path) -> Iterator[str]:
    """Dotted names of our own modules that a file imports."""
    for node in imports()[path]:
        names = [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = [whole if (whole := f"{node.module}.{name}") in MODULES else str(node.module) for name in names]
        yield from (name for name in names if name.split(".")[0] in PACKAGES)


def level_of(module: str, levels: tuple[set[str], ...], folder: str) -> tuple[int, str]:
    """Return (level, name) of the part of a folder, itself a folder or a module, in which a module lies."""
    name = module.removeprefix(folder + ".").split(".")[0]
    for level, names in enumerate(levels):
        if name in names:
            return level, name
    raise AssertionError(f"{module} has no level in {folder}: say on which one {name!r} belongs")


@cache
def arrows() -> list[tuple[str, str]]:
    return sorted({(module, target) for module, path in MODULES.items() for target in imported(path) if target != module})


def test_packages_meet_in_files_only() -> None:
    """And all of them in mrbokeh."""
    ends = [(a.split(".")[0], b.split(".")[0], f"{a} -> {b}") for a, b in arrows()]
    assert not [arrow for one, other, arrow in ends if other not in (one, "mrbokeh")]


@pytest.mark.parametrize(("folder", "levels"), [("mrbokeh", LEVELS), ("mrbokeh.renderers", RENDERER_LEVELS)])
def test_folders_import_from_lower_levels_only(folder: str, levels: tuple[set[str], ...]) -> None:
    inside = [(a, b) for a, b in arrows() if a.startswith(folder + ".") and b.startswith(folder + ".")]
    places = [(level_of(a, levels, folder), level_of(b, levels, folder), f"{a} -> {b}") for a, b in inside]
    wrong = [arrow for (above, source), (below, target), arrow in places if source != target and above >= below]
    assert not wrong


def test_no_cycles() -> None:
    graph: dict[str, set[str]] = {}
    for source, target in arrows():
        graph.setdefault(source, set()).add(target)
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join((*trail, module))
        if module not in done:
            for target in graph.get(module, ()):
                visit(target, (*trail, module))
            done.add(module)

    for module in list(graph):
        visit(module, ())


@pytest.mark.parametrize(
    ("library", "homes"),
    [("torch", {"training"})]
    + [("aiohttp", {"viewfinder", "datasets_scripts"})]  # the gallery looks at pages through a browser
    + [(name, {"viewfinder"}) for name in ("aiortc", "segno", "reportlab")]
    + [(name, {"capture"}) for name in ("rawpy", "pyexiv2", "exifread", "lensfunpy")]
    + [("pycolmap", {"capture", "viewfinder"}), ("gphoto2", set())],
)
def test_heavy_libraries_live_where_they_belong(library: str, homes: set[str]) -> None:
    """commands/doctor.py may ask torch for a GPU; three renderers and layering have twins on devices; data sets may write metadata.

    COLMAP's maps are made by capture and localised in by the viewfinder; tethered cameras shoot for one and look for the other,
    both through mrbokeh.system.gphoto2_library.
    """
    asking = {
        "mrbokeh.commands.doctor",
        "mrbokeh.compositing.plate_look.vignetting",
        "datasets_scripts.made_sets.simulated_camera",
        "mrbokeh.system.gphoto2_library",
    }
    users = {
        module
        for module, path in MODULES.items()
        for node in imports()[path]
        if library in {alias.name.split(".")[0] for alias in node.names} | {(getattr(node, "module", None) or "").split(".")[0]}
    }
    twins = (
        "mrbokeh.layering.torch_layering",
        "mrbokeh.renderers.polygon.torch_polygon",
        "mrbokeh.renderers.spreadlets.torch_spreadlets",
        "mrbokeh.renderers.layered_reconstruction.torch_reconstruction",
        "mrbokeh.system.torch_device",
        "mrbokeh.psf_models.torch_tracing",
        "mrbokeh.depth.views.torch_plane_sweep",
    )
    assert {user.split(".")[0] for user in users - asking if not (library == "torch" and user.startswith(twins))} <= homes


def test_no_drawers_for_anything() -> None:
    assert not {Path(path).stem for path in MODULES.values()} & {"utils", "util", "helpers", "common", "misc"}
