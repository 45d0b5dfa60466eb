"""`mrbokeh capture scale`: camera poses in metres, and the lens's focus calibrated against them."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, tell

_DICTIONARY = "DICT_4X4_50"
HELP = "\n\n".join(
    (
        "Find how many metres the unit of the camera poses is: from a ChArUco board in the scene, from a measured distance between two "
        "camera centres, and from the focus distances of the stacks. All that answer are kept in SCENE/reconstruction/scale.json "
        "with their disagreement; the board counts most, then the distance, then the focus.",
        "Then the focus and the growth of blur of every slice are calibrated against the depth: into stack.json, and as "
        "SCENE/lens_calibration.json for later stacks of that lens (--lens-calibration), which need no poses.",
        "One stack whose focus distances nobody stated has guessed metres; it needs no poses but one known length (--ruler) or distance "
        "(--distance-at), at pixels of its all-in-focus picture. What photographs state stays, what is told fixes the rest, and what is "
        "still guessed is said: two things at different depths tell how deep the scene is.",
        "Example:  mrbokeh capture scale STACK --ruler 310,220,480,224,0.05",
        "Example:  mrbokeh capture scale STACK --nearest last",
        "Example:  mrbokeh capture scale scene/ --board 8x6 --square 30 --marker 22",
        "Example:  mrbokeh capture scale scene/ --distance view_0,view_3,0.25",
        "Example:  mrbokeh capture scale other_scene/ --lens-calibration scene/lens_calibration.json",
    )
)


def scale_command(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="folder that `mrbokeh capture poses` worked on; a stack for --ruler and --distance-at")
    ],
    board: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNSxROWS|board.toml|board.json",
            help="squares of a ChArUco board in the scene, or its file, as `mrbokeh viewfinder board` writes one",
        ),
    ] = None,
    square_mm: Annotated[float | None, typer.Option("--square", metavar="MM", help="side of a square as measured on the print")] = None,
    marker_mm: Annotated[float | None, typer.Option("--marker", metavar="MM", help="side of a marker")] = None,
    dictionary: Annotated[str, typer.Option(help="of cv2.aruco")] = _DICTIONARY,
    distance: Annotated[str | None, typer.Option(metavar="VIEW_A,VIEW_B,METRES", help="between two camera centres")] = None,
    lens_calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="only put this calibration to use on the stacks; poses are not needed")
    ] = None,
    ruler: Annotated[
        list[str] | None,
        typer.Option(metavar="X1,Y1,X2,Y2,METRES", help="a known length between what is seen at two pixels of a stack; may be repeated"),
    ] = None,
    distance_at: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,METRES", help="a known distance from the lens to what is seen at a pixel of a stack; may be repeated"),
    ] = None,
    nearest: Annotated[
        Literal["first", "last"] | None,
        typer.Option(help="which slice of a stack is focused nearest; turns its depth where near and far were taken for one another"),
    ] = None,
    no_calibrate: Annotated[bool, typer.Option("--no-calibrate", help="leave the focus of the stacks as it is")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="find the scale again")] = False,
) -> None:
    from capture.scale.answer import parse_distance
    from capture.scale.board import board_from_options
    from capture.scale.metric_scale import ScaleRequest, scale_lines, scale_scene

    if ruler or distance_at or nearest:
        of_scenes = {
            "--board": board,
            "--square": square_mm,
            "--marker": marker_mm,
            "--dictionary": dictionary != _DICTIONARY,
            "--distance": distance,
            "--lens-calibration": lens_calibration,
            "--no-calibrate": no_calibrate,
        }
        if given := [name for name, value in of_scenes.items() if value is not None and value is not False]:
            raise InputError(
                f"--ruler, --distance-at and --nearest are for one stack, but {', '.join(given)} is for a whole scene: give one kind"
            )
        if overwrite and not (ruler or distance_at):
            raise InputError(
                "--overwrite replaces earlier lengths: add --ruler or --distance-at, or leave it out; --nearest works without it"
            )
        _tell(scene, ruler or [], distance_at or [], nearest, overwrite)
        return
    if lens_calibration is not None:
        _apply(scene, lens_calibration)
        return
    wanted_board = None if board is None else board_from_options(board, square_mm, marker_mm, dictionary)
    wanted_distance = None if distance is None else parse_distance(distance)
    for line in scale_lines(scale_scene(scene, ScaleRequest(wanted_board, wanted_distance, not no_calibrate, overwrite))):
        tell(line)


def _tell(folder: Path, rulers: list[str], distances: list[str], nearest: str | None, overwrite: bool) -> None:
    from capture.merging.metres.known_metres import Fact, parse_known_distance, parse_length
    from capture.merging.metres.stack_metres import apply_known_metres, apply_known_nearest, lines_of
    from mrbokeh.stacks.focal_stack import find_focal_stacks
    from mrbokeh.stacks.guessed_metres import metres_note

    facts: list[Fact] = [*[parse_length(each) for each in rulers], *[parse_known_distance(each) for each in distances]]
    stacks = find_focal_stacks(folder)
    if len(stacks) > 1:
        raise InputError(
            f"{folder} has {len(stacks)} stacks: give the folder of the one whose pixels these are, such as {stacks[0].folder}"
        )
    stack = stacks[0]
    if nearest is not None:
        stack = apply_known_nearest(stack, nearest == "first")
        tell(f"{stack.folder}: the {nearest} slice is the nearest")
    if facts:
        tell("\n".join(lines_of(apply_known_metres(stack, facts, overwrite))))
    elif note := metres_note(stack):
        guess(note)


def _apply(scene: Path, path: Path) -> None:
    from capture.poses.lens_calibration import calibrate_scene, read_lens_calibration

    for stack in calibrate_scene(scene, read_lens_calibration(path)):
        tell(f"{stack.folder}: focus distances calibrated by {path}")
