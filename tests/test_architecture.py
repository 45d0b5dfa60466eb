"""Who may import whom (ARCHITECTURE.md), read from the syntax tree; imports inside functions count like any other."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("mrbokeh", "capture", "training", "viewfinder", "datasets_scripts")

# The rows of the house, top first: a module imports from lower rows only. A name ending in a dot is a whole folder.
ROWS = (
    ("cli",),
    ("commands.",),
    ("demo.",),
    ("lens_drawing", "psf_bank_drawing", "stack_pictures", "stack_compositing", "transferring"),
    ("picture_checks.", "refocusing"),
    ("shots.",),
    ("camera_track.",),
    ("staging.",),
    ("moving_layers.",),
    ("plate_look.",),
    ("compositing.", "overlay", "_overlay_numba", "tilt_shift"),
    ("plate",),
    ("depth_sources.",),
    ("renderers.choose_bank",),
    ("renderers.choose",),
    ("renderers.",),
    ("renderers.base",),
    ("lens_fitting.", "lens_matching."),
    ("film_plane",),
    ("psf_models.", "spreadlets_build"),
    ("psf_bank_export", "bank_fits_file"),
    ("focal_stack_dataset", "guessed_metres", "focus_places"),
    ("picture_sources.",),
    ("focal_stack", "video_io", "scene.", "contact_sheet", "psf_bank_file", "light_field_samples_file", "motion_file"),
    ("video_packets",),
    ("video_writer",),
    ("video_frames", "video_audio"),
    ("video_encodings", "video_decoding"),
    ("video_color", "video_alpha", "_video_frames_numba"),
    ("capture_bundle", "held_lens"),
    ("lens_file", "camera_file", "charuco.", "photograph"),
    ("lens_distortion.",),
    ("lens_file_values",),
    ("exr_layers.", "finished_picture"),
    ("plate_alpha",),
    ("image_io", "camera_rgb"),
    ("color_management", "blender."),
    ("exr_primaries",),
    ("exr_io", "picture_codec"),
    ("srgb_codes", "tiff_pixels"),
    ("exif_orientation",),
    ("tiff_tags",),
    ("layering",),
    ("other_view",),
    ("slices",),
    ("optics",),
    ("slice_islands", "_slice_islands_numba"),
    ("slice_sorting", "_slices_numba"),
    ("hidden_background", "_hidden_background_numba", "_depth_edges_numba", "_rims_numba"),
    ("sheets", "_sheets_numba"),
    ("lit_pixels", "_lit_pixels_numba", "motion", "_motion_numba"),
    ("spreading", "light_field_samples", "drawn_diameters", "_drawn_diameters_numba"),
    ("spreadlets_file",),
    ("spreadlets",),
    ("spreadlet_values", "_spreadlets_numba"),
    ("laplacian_integration", "_laplacian_integration_numba"),
    ("pixel_box", "_pixel_box_numba"),
    ("lens",),
    ("bank_apertures", "bank_low_rank"),
    ("polygon_rectification", "directional_differences", "low_rank", "polygon_fit", "bank_lattice"),
    ("rectification_walks", "_rectification_lines_numba", "_rectification_corners_numba", "_rectification_walks_numba"),
    ("outline_symmetry",),
    ("outline_geometry", "_outline_geometry_numba"),
    ("aperture",),
    ("aperture_modifiers",),
    ("aperture_shapes",),
    ("psf", "_polygon_coverage_numba", "psf_bank"),
    ("nested_grid", "proportional_grid", "psf_axis", "level_plane"),
    ("layer", "camera", "color", "image_metrics", "field_position", "png_chunks", "quiet_opencv", "cut_out"),
    ("html_page",),
    (
        "atomic_files",
        "progress",
        "interrupts",
        "malloc_settings",
        "workers",
        "zeroed_memory",
        "torch_device",
        "gphoto2_library",
        "sound_values",
        "option_names",
    ),
    ("errors",),
)
ALLOWED_ACROSS = {
    "capture": {"mrbokeh"},
    "training": {"mrbokeh"},
    "viewfinder": {"mrbokeh"},
    "datasets_scripts": {"mrbokeh"},
    "mrbokeh": set(),
}


def modules() -> dict[str, Path]:
    files = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


MODULES = modules()


@cache
def imports_of(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """Every import statement of a file, also those within functions."""
    return [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, (ast.Import, ast.ImportFrom))]


def imported(path: Path) -> Iterator[str]:
    """Dotted names of our own modules that a file imports."""
    for node in imports_of(path):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            assert node.level == 0, f"{path}: relative import"
            names = [
                f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in MODULES else str(node.module) for alias in node.names
            ]
        yield from (name for name in names if name.split(".")[0] in PACKAGES)


def row_of(module: str) -> int:
    """The row of a module of mrbokeh; an exact name goes before its folder."""
    name = module.removeprefix("mrbokeh.")
    for exact in (True, False):
        for row, entries in enumerate(ROWS):
            if any(name == entry if exact else entry.endswith(".") and (name + ".").startswith(entry) for entry in entries):
                return row
    raise AssertionError(f"{module} has no row in ROWS: say where in the house it belongs")


def arrows() -> list[tuple[str, str]]:
    return sorted({(module, target) for module, path in MODULES.items() for target in imported(path) if target != module})


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_meet_in_files_only(package: str) -> None:
    allowed = ALLOWED_ACROSS[package] | {package}
    wrong = [f"{a} -> {b}" for a, b in arrows() if a.split(".")[0] == package and b.split(".")[0] not in allowed]
    assert not wrong


def test_arrows_in_mrbokeh_point_downwards() -> None:
    inner = [(a, b) for a, b in arrows() if a.startswith("mrbokeh.") and b.startswith("mrbokeh.")]
    wrong = [f"{a} -> {b}" for a, b in inner if row_of(a) > row_of(b) or (row_of(a) == row_of(b) and not _one_room(a, b))]
    assert not wrong


def _one_room(a: str, b: str) -> bool:
    """Both in one folder below mrbokeh/, or b is a private part of a's row (a compiled twin)."""
    folder = b.rsplit(".", 1)[0]
    return b.split(".")[-1].startswith("_") or (folder != "mrbokeh" and (a == folder or a.startswith(folder + ".")))


def test_renderers_do_not_import_their_siblings() -> None:
    """Twins on devices (torch_*) are no siblings: each belongs to one renderer. Nor is what opens a session."""
    public = {name for name in MODULES if name.startswith("mrbokeh.renderers.") and not name.split(".")[-1].startswith("_")}
    siblings = {name for name in public if ".torch_" not in name} - {
        f"mrbokeh.renderers.{name}" for name in ("base", "choose", "choose_bank", "onnx_sessions")
    }
    assert not [f"{a} -> {b}" for a, b in arrows() if a in siblings and b in siblings]


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
    """commands/doctor.py may ask torch for a GPU; two renderers have twins on devices; data sets may write metadata.

    COLMAP's maps are made by capture and localised in by the viewfinder; tethered cameras shoot for one and look for the other,
    both through mrbokeh.gphoto2_library.
    """
    asking = {
        "mrbokeh.commands.doctor",
        "mrbokeh.plate_look.lensfun_falloff",
        "mrbokeh.lens_distortion.lensfun_database",
        "datasets_scripts.dng_writer",
        "mrbokeh.gphoto2_library",
    }
    users = {
        module
        for module, path in MODULES.items()
        for node in imports_of(path)
        if library in {alias.name.split(".")[0] for alias in node.names} | {(getattr(node, "module", None) or "").split(".")[0]}
    }
    twins = ("mrbokeh.renderers.torch_", "mrbokeh.torch_device", "mrbokeh.psf_models.torch_tracing", "capture.views.torch_plane_sweep")
    assert {user.split(".")[0] for user in users - asking if not (library == "torch" and user.startswith(twins))} <= homes


def test_no_drawers_for_anything() -> None:
    assert not {Path(path).stem for path in MODULES.values()} & {"utils", "util", "helpers", "common", "misc"}
