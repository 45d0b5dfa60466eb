"""`mrbokeh capture solve`: the camera of one photograph from its straight lines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, say, tell, warn
from mrbokeh.system.typed_numbers import numbers_in

if TYPE_CHECKING:
    from mrbokeh.solving.solve_camera import Line
    from mrbokeh.solving.solved_camera import SolvedCamera
    from mrbokeh.stacks.photograph import Photograph

HELP = "\n\n".join(
    (
        "Find the camera of one photograph: its focal length, how it was held, the horizon and the ground, from straight lines in rooms, "
        "on streets and tables. Lines along three directions that are square to one another are looked for, of which one is upright.",
        "A focal length that EXIF or --focal-length states is taken, and compared with what the lines say. Without either it is solved, "
        "and guessed where the lines do not tell it. The whole picture is needed: one that was cropped has another middle.",
        "Where lines are few, give some by hand: --line X1,Y1,X2,Y2,y for an upright edge, x and z for level edges along two directions "
        "that are square to one another (which is which is yours to choose), h for the horizon. They decide; what is found counts where it "
        "agrees.",
        "--out is read by `mrbokeh.solving`; look at --picture before you trust a camera of low confidence.",
        "Example:  mrbokeh capture solve room.jpg --out camera.json --picture grid.png",
        "Example:  mrbokeh capture solve room.jpg --out camera.json --height 1.6",
        "Example:  mrbokeh capture solve street.jpg --out camera.json --length 812,1490,820,1102,1.75,y",
        "Example:  mrbokeh capture solve old.png --focal-length 35 --sensor-width 36 --length 410,900,980,905,2.4 --out camera.json",
    )
)
_LINE = "--line must be two pixels and a direction, X1,Y1,X2,Y2,x or y or z, or h for the horizon"


def solve_command(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="a photograph as it came from the camera, RAW or developed, not cropped")],
    out: Annotated[Path, typer.Option(metavar="camera.json", help="the camera: keys with units and standard deviations")],
    picture: Annotated[
        Path | None, typer.Option(metavar="grid.png", help="the photograph with grid, horizon and lines coloured by direction")
    ] = None,
    focal_length: Annotated[float | None, typer.Option(metavar="MM", help="focal length in mm, instead of EXIF's")] = None,
    sensor_width: Annotated[float | None, typer.Option(metavar="MM", help="sensor width in mm, instead of EXIF's")] = None,
    line: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X1,Y1,X2,Y2,x|y|z|h", help="an edge by hand, upright (y) or level (x, z), or the horizon (h); may be repeated"
        ),
    ] = None,
    height: Annotated[float | None, typer.Option(metavar="METRES", help="of the camera above the ground, else 1.5 is guessed")] = None,
    length: Annotated[
        str | None,
        typer.Option(
            metavar="X1,Y1,X2,Y2,METRES[,y]",
            help="a known length between two pixels of the ground, or with y of something upright, from its foot on the ground to its top, "
            "such as a person, instead of --height",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace files that exist")] = False,
) -> None:
    from mrbokeh.figures.solved_picture import write_solved_picture
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.solving.solve_camera import solve_camera
    from mrbokeh.solving.solved_camera import write_solved_camera
    from mrbokeh.stacks.photograph import read_photograph
    from mrbokeh.system.atomic_files import require_safe_outputs

    require_suffix(out, (".json",), "--out")
    if picture is not None:
        require_suffix(picture, (".png", ".jpg", ".jpeg"), "--picture")
    require_safe_outputs((out, picture), (photo,), overwrite)
    if height is not None and length is not None:
        raise InputError("give --height, or --length from which it follows, not both")
    lines, ruler = [parse_line(each) for each in line or []], None if length is None else parse_length(length)
    photograph = with_stated(read_photograph(photo), focal_length, sensor_width)
    if photograph.cut_from_px is not None:
        warn(f"{photograph.cut_told(photo)}: its middle is taken to be that of the whole")
    camera = solve_camera(photograph.rgb, stated_focal_px(photograph, photo), lines).of_sensor(photograph.sensor_width_mm)
    camera = camera.standing(height) if height is not None else camera
    off_m = 0.0
    if ruler is not None:
        ends_px, metres, upright = ruler
        off_m = camera.height_off_m(ends_px, metres, upright=upright)
        camera = camera.with_height(ends_px, metres) if upright else camera.with_length(ends_px, metres)
    write_solved_camera(out, camera)
    if picture is not None:
        write_solved_picture(picture, photograph.rgb, camera)
    _tell(camera, off_m, f"wrote {out}" + (f" and {picture}" if picture is not None else ""))


def parse_line(text: str) -> "Line":
    """Return an edge from X1,Y1,X2,Y2 and its direction. Raises InputError."""
    from mrbokeh.solving.solve_camera import AXES, HORIZON, Line

    ends, _, axis = text.rpartition(",")
    if axis not in (*AXES, HORIZON):
        raise InputError(f"{_LINE}, got {text!r}")
    x1, y1, x2, y2 = numbers_in(ends, _LINE, (4,))
    return Line((x1, y1, x2, y2), axis)


def parse_length(text: str) -> tuple[tuple[float, float, float, float], float, bool]:
    """Return the ends, the metres, and whether it is upright, of X1,Y1,X2,Y2,METRES[,y]. Raises InputError."""
    numbers = text.removesuffix(",y")
    x1, y1, x2, y2, metres = numbers_in(
        numbers, "--length must be two pixels and metres, X1,Y1,X2,Y2,METRES, with ,y after that for something upright", (5,)
    )
    return (x1, y1, x2, y2), metres, numbers != text


def with_stated(photograph: "Photograph", focal_length_mm: float | None, sensor_width_mm: float | None) -> "Photograph":
    """Return the photograph with what options state in place of what its file does. Raises InputError for what cannot be."""
    told = {"focal_length_mm": focal_length_mm, "sensor_width_mm": sensor_width_mm}
    given = {name: value for name, value in told.items() if value is not None}
    for name, value in given.items():
        if not 0.0 < value < float("inf"):
            raise InputError(f"expected --{name.removesuffix('_mm').replace('_', '-')} in mm, above 0, got {value:g}")
    stated = photograph.stating(given)
    if focal_length_mm is not None and stated.sensor_width_mm is None:
        raise InputError("--focal-length needs the width of the sensor, which the file does not state: add --sensor-width MM")
    return stated


def stated_focal_px(photograph: "Photograph", photo: Path) -> float | None:
    """Return the focal length in pixels that a photograph states, None if it states none that can be meant."""
    if photograph.focal_length_mm is None or photograph.sensor_width_mm is None:
        return None
    height_px, width_px = photograph.rgb.shape[:2]
    focal_px = photograph.focal_length_mm / photograph.sensor_width_mm * width_px
    if not 0.3 < focal_px / max(height_px, width_px) < 30.0:
        warn(
            f"{photo} states {photograph.focal_length_mm:.4g} mm on a sensor {photograph.sensor_width_mm:.4g} mm wide, which is no "
            f"photograph's lens: it is left out (--focal-length, --sensor-width)"
        )
        return None
    return focal_px


def _tell(camera: "SolvedCamera", height_off_m: float, wrote: str) -> None:
    from mrbokeh.solving.solved_camera import GUESSED, LOW, SOLVED, camera_document

    own = "" if camera.focal_length_mm is None else f" ({camera.focal_length_mm:.3g} mm)"
    spread = f" +- {camera.focal_length_sd_px:.0f}" if camera.focal_length_source == SOLVED else ""
    (_, left_px), (_, right_px) = camera.horizon_px
    tell(
        f"focal length {camera.focal_length_px:.0f}{spread} px{own}, {camera.focal_length_35mm:.3g} mm on full frame: "
        f"{camera.focal_length_source}",
        known={} if camera.focal_length_source != "known" else {"focal_length_px": camera.focal_length_px},
        **{name: value for name, value in camera_document(camera).items() if name != "assumed"},
    )
    tell(
        f"roll {camera.roll_deg:+.2f} +- {camera.roll_sd_deg:.2f} degrees, pitch {camera.pitch_deg:+.2f} +- {camera.pitch_sd_deg:.2f}; "
        f"horizon from {left_px:.0f} px on the left to {right_px:.0f} px on the right, down from the top"
    )
    counts = camera.segments_by_direction
    say(f"lines: {counts.get('x', 0)} along x, {counts.get('y', 0)} upright (y), {counts.get('z', 0)} along z")
    if camera.camera_height_source == GUESSED:
        guess(f"guessed: the camera stands {camera.camera_height_m:g} m above the ground (--height METRES, or --length)")
    else:
        off = f" +- {height_off_m:.2g}" if height_off_m else ""
        say(f"the camera stands {camera.camera_height_m:.3g}{off} m above the ground")
    for sentence in camera.assumed:
        guess(sentence) if sentence.startswith("guessed") else say(sentence)
    if disagreement := camera.disagreement():
        warn(f"{disagreement}: the picture may have been cropped, or its lines mislead; check --focal-length and --sensor-width")
    tell(f"confidence: {camera.confidence}; {wrote}")
    if camera.confidence == LOW:
        warn("this camera may be wrong: look at --picture, and give --line for edges that you know, or --focal-length")
