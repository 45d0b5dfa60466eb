"""`mrbokeh capture matchmove`: the camera of every frame of a clip, from the clip alone."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, say, tell, warn

if TYPE_CHECKING:
    from capture.matchmove.clip_matchmove import Matchmove

HELP = "\n\n".join(
    (
        "Find the camera of every frame of a clip: one that only turns (a pan from a tripod, a phone held still), one before a flat scene "
        "(a wall, a chart, a floor), or a path through space, by COLMAP. The simplest that explains what is seen is taken and said.",
        "The scale is arbitrary unless something of known size is told: a printed board in the clip (--board), two pixels on the ground "
        "and their distance (--ruler), or how far the camera went between two frames (--distance). --ground puts the world's floor under "
        "three pixels or more, its origin under the first, x towards the second: what stands at 0,0,0 in a scene file stands there; up is "
        "-z, as of a printed board. A flat scene is its own floor. A camera that only turns sees none: --horizon and --camera-height tell.",
        "What was solved stays in --work: the same command with --overwrite and another --ground or --horizon solves nothing anew. "
        "Delete that folder to begin again. Beside the track TRACK.html "
        "shows how each frame fits, and a grid on the ground.",
        "Example:  mrbokeh capture matchmove clip.mp4 --out track.json --ground 0:300,900/1500,900/900,700 --ruler 0:300,900/1500,900/2.4",
        "Example:  mrbokeh capture matchmove pan.mp4 --out track.json --horizon 0:0,310/1920,296 --camera-height 1.6",
    )
)

_SHORTEST_MM, _LONGEST_MM, _HIGHEST_M = 5.0, 2000.0, 20_000.0


def matchmove_command(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="video of a scene at rest")],
    out: Annotated[Path, typer.Option(metavar="TRACK", help="track.json, .chan, transforms.json, .jsonl, or a folder for COLMAP's own")],
    keyframes: Annotated[int, typer.Option(min=3, help="at most so many are solved at once")] = 40,
    camera_model: Annotated[str, typer.Option(help="SIMPLE_RADIAL (one term of distortion), RADIAL (two) or auto")] = "SIMPLE_RADIAL",
    mapper: Annotated[str, typer.Option(help="incremental, or global (GLOMAP)")] = "incremental",
    max_image_size: Annotated[int, typer.Option(min=200, metavar="PX", help="features are sought in pictures no wider or higher")] = 1600,
    focal_length: Annotated[
        float | None, typer.Option(metavar="MM", help="on full frame (35 mm equivalent), for clips that do not tell it")
    ] = None,
    board: Annotated[Path | None, typer.Option(metavar="BOARD.json", help="a printed board in the clip: gives metres")] = None,
    ground: Annotated[str | None, typer.Option(metavar="FRAME:X,Y/X,Y/X,Y", help="pixels with flat ground between them")] = None,
    ruler: Annotated[str | None, typer.Option(metavar="FRAME:X,Y/X,Y/METRES", help="between two pixels on the ground")] = None,
    distance: Annotated[str | None, typer.Option(metavar="FRAME,FRAME,METRES", help="between the cameras of two frames")] = None,
    horizon: Annotated[
        str | None, typer.Option(metavar="FRAME:X,Y/X,Y", help="of a camera that turns: two pixels of it, seen or not")
    ] = None,
    camera_height: Annotated[float | None, typer.Option(metavar="METRES", help="above the ground, of a camera that turns")] = None,
    work: Annotated[Path | None, typer.Option(metavar="DIR", help="folder for what was solved; default: beside OUT")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the track; what was solved is used again")] = False,
) -> None:
    from capture.matchmove.clip_matchmove import MatchmoveSettings, matchmove_clip
    from capture.matchmove.ground import parse_frame_distance, parse_ground, parse_horizon, parse_ruler
    from capture.matchmove.solve_page import write_solve_page
    from mrbokeh.system.console import kept_when_interrupted
    from mrbokeh.tracking.camera_track.formats import format_of_name, write_track
    from mrbokeh.tracking.charuco.board import read_board

    if not clip.is_file():
        raise InputError(f"expected a video at {clip}, but {'it is a folder' if clip.is_dir() else 'there is none'}")
    page = out.with_name(f"{out.stem}.html")
    require_safe_outputs((out, page), (clip, board), overwrite)
    format_of_name(out)
    if focal_length is not None and not _SHORTEST_MM <= focal_length <= _LONGEST_MM:
        raise InputError(f"--focal-length: expected {_SHORTEST_MM:g} to {_LONGEST_MM:g} mm of full frame, got {focal_length:g}")
    if camera_height is not None and not 0.0 < camera_height <= _HIGHEST_M:
        raise InputError(f"--camera-height: expected metres above 0, at most {_HIGHEST_M:g}, got {camera_height:g}")
    settings = MatchmoveSettings(
        keyframes=keyframes,
        camera_model=camera_model,
        mapper=mapper,
        max_image_size_px=max_image_size,
        focal_length_35mm=focal_length,
        board=None if board is None else read_board(board),
        ground=None if ground is None else parse_ground(ground),
        ruler=None if ruler is None else parse_ruler(ruler),
        distance=None if distance is None else parse_frame_distance(distance),
        horizon=None if horizon is None else parse_horizon(horizon),
        camera_height_m=camera_height,
    )
    folder = work or out.with_name(f"{out.stem}_matchmove")
    with kept_when_interrupted(f"keyframes and what was solved, as far as it is finished, are kept in {folder}"):
        made = matchmove_clip(clip, folder, settings)
    missing = write_track(out, made.track)
    write_solve_page(page, clip, made)
    scales = (("board", board), ("ruler", ruler), ("distance", distance), ("camera-height", camera_height))
    _tell(out, page, made, next((name for name, told in scales if told), None))
    if missing:
        warn(f"{out} cannot hold and lacks: {', '.join(missing)}")


def _tell(out: Path, page: Path, made: "Matchmove", told_by: str | None) -> None:
    solve = made.solve
    say(f"solved as {solve.why}")
    guess(f"the clip does not tell how the camera was held: mrbokeh takes {' and '.join(made.assumed)}" if made.assumed else "")
    count, lost = len(solve.times_s), solve.lost
    scale = "scale arbitrary" if told_by is None else f"in metres, by --{told_by}"
    lost_told = f", {len(lost)} lost ({', '.join(map(str, lost[:8]))}{', ...' if len(lost) > 8 else ''})" if lost else ""
    parallax = f", median parallax {solve.parallax_deg:.1f} degrees" if solve.parallax_deg else ""
    tell(
        f"{out}: {count - len(lost)} of {count} frames{lost_told}; {scale}; residual {solve.residual_px:.2f} px (median of what rests)"
        f"{parallax}",
        frames=count - len(lost),
        kind=solve.kind,
        residual_px=solve.residual_px,
        parallax_deg=solve.parallax_deg,
    )
    if solve.warnings:
        warn(f"this track may be wrong: {'; '.join(solve.warnings)}; look at the grid in {page} before you trust it")
    else:
        say(f"{page} shows how each frame fits")
