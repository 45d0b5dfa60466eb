"""`mrbokeh capture scale`: camera poses in metres, and the lens's focus calibrated against them."""

from pathlib import Path
from typing import Annotated

import typer

HELP = "\n\n".join(
    (
        "Find how many metres the unit of the camera poses is: from a ChArUco board in the scene, from a measured distance between two "
        "camera centres, and from the focus distances of the stacks. All that answer are kept in SCENE/reconstruction/scale.json "
        "with their disagreement; the board counts most, then the distance, then the focus.",
        "Then the focus and the growth of blur of every slice are calibrated against the depth: into stack.json, and as "
        "SCENE/lens_calibration.json for later stacks of that lens (--lens-calibration), which need no poses.",
        "Example:  mrbokeh capture scale scene/ --board 8x6 --square-mm 30 --marker-mm 22",
        "Example:  mrbokeh capture scale scene/ --distance view_0,view_3,0.25",
        "Example:  mrbokeh capture scale other_scene/ --lens-calibration scene/lens_calibration.json",
    )
)


def scale_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="folder that `mrbokeh capture poses` worked on")],
    board: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNSxROWS|board.toml|board.json",
            help="squares of a ChArUco board in the scene, or its file, as `mrbokeh viewfinder board` writes one",
        ),
    ] = None,
    square_mm: Annotated[float | None, typer.Option(metavar="MM", help="side of a square as measured on the print")] = None,
    marker_mm: Annotated[float | None, typer.Option(metavar="MM", help="side of a marker")] = None,
    dictionary: Annotated[str, typer.Option(help="of cv2.aruco")] = "DICT_4X4_50",
    distance: Annotated[str | None, typer.Option(metavar="VIEW_A,VIEW_B,METRES", help="between two camera centres")] = None,
    lens_calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="only put this calibration to use on the stacks; poses are not needed")
    ] = None,
    calibrate: Annotated[bool, typer.Option("--calibrate/--no-calibrate", help="calibrate the focus of the stacks")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="find the scale again")] = False,
) -> None:
    from capture.views.board_options import board_from_options
    from capture.views.metric_scale import ScaleRequest, scale_scene
    from capture.views.scale_distance import parse_distance
    from capture.views.scale_text import scale_lines

    if lens_calibration is not None:
        _apply(scene, lens_calibration)
        return
    wanted_board = None if board is None else board_from_options(board, square_mm, marker_mm, dictionary)
    wanted_distance = None if distance is None else parse_distance(distance)
    for line in scale_lines(scale_scene(scene, ScaleRequest(wanted_board, wanted_distance, calibrate, overwrite))):
        typer.echo(line)


def _apply(scene: Path, path: Path) -> None:
    from capture.views.lens_calibration import read_lens_calibration
    from capture.views.lens_calibration_stacks import calibrate_scene

    for stack in calibrate_scene(scene, read_lens_calibration(path)):
        typer.echo(f"{stack.folder}: focus distances calibrated by {path}")
