"""`mrbokeh capture plan`: how many slices, and where to focus them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import tell
from mrbokeh.system.typed_numbers import numbers_in

if TYPE_CHECKING:
    from capture.tether.focus_plan import FocusPlan, FocusRange
    from mrbokeh.optics.lens import Lens

HELP = "\n\n".join(
    (
        "Plan a focus bracket: as few slices as keep every point between two distances sharp to N pixels in one of them.",
        "Slices are equally far apart in dioptres (1/metre), in which blur grows evenly. Halfway between two of them the circle of "
        "confusion is largest: the residual. Distances count from the lens (--origin film_plane: from the mark on the camera, as a tape "
        "measures them); the table shows both.",
        "With --scale every slice goes to a mark of the lens's scale (always counted from the film plane); with --motor-step slices are "
        "whole motor steps apart. Both may change the residual, which the table tells.",
        "Example:  mrbokeh capture plan lens.json --near 0.5 --far 3 --image-width 6000 --out plan.json",
        "Example:  mrbokeh capture plan --focal-length 35 --f-number 1.8 --sensor-width 23.5 --near 0.5 --far inf --image-width 6000 "
        "--csv plan.csv",
    )
)


def plan_command(
    near: Annotated[float, typer.Option(metavar="M", help="nearest distance that has to be sharp, in metres")],
    far: Annotated[float, typer.Option(metavar="M", help="farthest, in metres; inf is allowed")],
    image_width: Annotated[int, typer.Option(min=1, metavar="N", help="width of the photographs in pixels")],
    lens: Annotated[Path | None, typer.Argument(metavar="[LENS.json]", help="lens file, instead of the three options below")] = None,
    focal_length: Annotated[float | None, typer.Option(metavar="MM", help="focal length in mm")] = None,
    f_number: Annotated[float | None, typer.Option(metavar="N", help="f-number (also instead of the lens file's)")] = None,
    sensor_width: Annotated[float | None, typer.Option(metavar="MM", help="sensor width in mm: 36 full frame, 23.5 APS-C")] = None,
    residual: Annotated[float, typer.Option(metavar="PX", help="largest circle of confusion between slices, a diameter in pixels")] = 1.0,
    origin: Annotated[str, typer.Option(help="where --near and --far count from: lens or film_plane")] = "lens",
    scale: Annotated[
        str | None, typer.Option(metavar="M,M,...", help="marks of the lens's distance scale in metres, e.g. 0.5,0.6,inf")
    ] = None,
    motor_step: Annotated[float | None, typer.Option(metavar="D", help="dioptres per step of the focus motor")] = None,
    out: Annotated[Path | None, typer.Option(metavar="plan.json", help="for `mrbokeh capture shoot`")] = None,
    csv: Annotated[Path | None, typer.Option(metavar="plan.csv", help="the table, for shooting by hand")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace files that exist")] = False,
) -> None:
    from capture.tether.focus_plan import plan_focus, plan_for_motor, print_plan, write_plan, write_plan_table
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.system.atomic_files import require_safe_outputs

    if scale is not None and motor_step is not None:
        raise InputError("give either --scale, for a ring turned by hand, or --motor-step, for a motor")
    for path, suffix, name in ((out, ".json", "--out"), (csv, ".csv", "--csv")):
        if path is not None:
            require_suffix(path, (suffix,), name)
    require_safe_outputs((out, csv), (lens,), overwrite)
    planned_lens = planned_for(lens, focal_length, f_number, sensor_width, near)
    focus_range = range_from(origin, near, far, planned_lens)
    if motor_step is not None:
        plan = plan_for_motor(planned_lens, focus_range, image_width, residual, motor_step_dioptres=motor_step)
    else:
        plan = plan_focus(planned_lens, focus_range, image_width, residual)
    plan = plan if scale is None else rounded_to(plan, scale)
    print_plan(plan)
    if out is not None:
        write_plan(out, plan)
        tell(f"wrote {out}")
    if csv is not None:
        write_plan_table(csv, plan)
        tell(f"wrote {csv}")


def planned_for(
    path: Path | None, focal_length: float | None, f_number: float | None, sensor_width: float | None, focus_m: float
) -> "Lens":
    """Return the lens of a file, or of three numbers; an f-number goes before the file's."""
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.choose import read_lens

    if path is not None:
        if focal_length is not None or sensor_width is not None:
            raise InputError("the lens file states focal length and sensor width: leave --focal-length and --sensor-width out")
        lens = read_lens(path)
        return lens if f_number is None else lens.stating({"f_number": f_number})
    if focal_length is None or f_number is None or sensor_width is None:
        raise InputError("give a lens file, or --focal-length, --f-number and --sensor-width")
    return Lens(focal_length, f_number, focus_m, sensor_width)


def range_from(origin: str, near_m: float, far_m: float, lens: "Lens") -> "FocusRange":
    from capture.tether.focus_plan import FocusRange

    if origin not in ("lens", "film_plane"):
        raise InputError(f"--origin must be lens or film_plane, got {origin!r}")
    if origin == "lens":
        return FocusRange(near_m, far_m)
    return FocusRange.from_film_plane(near_m, far_m, lens.focal_length_mm)


def rounded_to(plan: "FocusPlan", text: str) -> "FocusPlan":
    """Round a plan to the marks of --scale, which count from the film plane, as they are engraved."""
    from capture.tether.focus_plan import on_scale
    from mrbokeh.optics.lens import lens_distance_m

    marks_m = numbers_in(text, "--scale must be metres with commas between them, such as 0.5,0.6,0.8,1,2,inf")
    from_lens = [lens_distance_m(each, plan.lens.focal_length_mm) if each > 0.0 else each for each in marks_m]
    return on_scale(plan, [each for each in from_lens if each is not None])
