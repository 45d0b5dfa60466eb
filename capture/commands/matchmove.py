"""`mrbokeh capture matchmove`: the camera of every frame of a clip, from the clip alone."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.channel import tell, warn
from mrbokeh.system.errors import InputError

HELP = "\n\n".join(
    (
        "Find the camera of every frame of a clip with COLMAP: keyframes are chosen by motion and placed, then all frames against them.",
        "The scale is arbitrary unless something of known size is told: a printed board in the clip (--board), two pixels on the ground "
        "and their distance (--ruler), or how far the camera went between two frames (--distance). --ground puts the world's floor under "
        "three pixels or more, its origin under the first, x towards the second: what stands at 0,0,0 in a scene file stands there.",
        "A camera that only turns, or a scene that moves by itself, is refused. Keyframes and COLMAP's files stay in --work, with which "
        "an interrupted run goes on, and other --ground or --board are tried at once.",
        "Example:  mrbokeh capture matchmove clip.mp4 --out track.json --ground 0:300,900/1500,900/900,700 --ruler 0:300,900/1500,900/2.4",
    )
)


def matchmove_command(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="video of a scene at rest")],
    out: Annotated[Path, typer.Option(metavar="TRACK", help="track.json, .chan, transforms.json, .jsonl, or a folder for COLMAP's own")],
    keyframes: Annotated[int, typer.Option(min=3, help="at most so many go to COLMAP")] = 40,
    camera_model: Annotated[str, typer.Option(help="SIMPLE_RADIAL (one term of distortion), RADIAL (two) or auto")] = "SIMPLE_RADIAL",
    mapper: Annotated[str, typer.Option(help="incremental, or global (GLOMAP)")] = "incremental",
    max_image_size: Annotated[int, typer.Option(min=200, metavar="PX", help="features are sought in pictures no wider or higher")] = 1600,
    board: Annotated[Path | None, typer.Option(metavar="BOARD.json", help="a printed board in the clip: gives metres")] = None,
    ground: Annotated[str | None, typer.Option(metavar="FRAME:X,Y/X,Y/X,Y", help="pixels with flat ground between them")] = None,
    ruler: Annotated[str | None, typer.Option(metavar="FRAME:X,Y/X,Y/METRES", help="between two pixels on the ground")] = None,
    distance: Annotated[str | None, typer.Option(metavar="FRAME,FRAME,METRES", help="between the cameras of two frames")] = None,
    work: Annotated[Path | None, typer.Option(metavar="DIR", help="folder for COLMAP; default: beside OUT")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the track, and find poses again from the start")] = False,
) -> None:
    from capture.matchmove.clip_matchmove import MatchmoveSettings, matchmove_clip
    from capture.matchmove.ground import parse_frame_distance, parse_ground, parse_ruler
    from mrbokeh.system.console import kept_when_interrupted
    from mrbokeh.tracking.camera_track.formats import format_of_name, write_track
    from mrbokeh.tracking.charuco.board import read_board

    if not clip.is_file():
        raise InputError(f"expected a video at {clip}, but {'it is a folder' if clip.is_dir() else 'there is none'}")
    require_safe_outputs((out,), (clip, board), overwrite)
    format_of_name(out)
    printed = None if board is None else read_board(board)
    settings = MatchmoveSettings(
        keyframes=keyframes,
        camera_model=camera_model,
        mapper=mapper,
        max_image_size_px=max_image_size,
        board=printed,
        overwrite=overwrite,
        ground=None if ground is None else parse_ground(ground),
        ruler=None if ruler is None else parse_ruler(ruler),
        distance=None if distance is None else parse_frame_distance(distance),
    )
    folder = work or out.with_name(f"{out.stem}_matchmove")
    with kept_when_interrupted(f"keyframes and COLMAP's files, as far as they are finished, are kept in {folder}", overwrite):
        made = matchmove_clip(clip, folder, settings)
    missing = write_track(out, made.track)
    told_by = next((name for name, told in (("board", board), ("ruler", ruler), ("distance", distance)) if told), None)
    scale = "scale arbitrary" if told_by is None else f"in metres, by the {told_by}"
    lost = f", {len(made.lost)} lost ({', '.join(map(str, made.lost[:8]))}{', ...' if len(made.lost) > 8 else ''})" if made.lost else ""
    tell(
        f"{out}: {len(made.track.frames)} of {made.frame_count} frames from {len(made.model.views)} keyframes{lost}; {scale}; "
        f"residual {made.residual_px:.2f} px RMS, median parallax {made.parallax_deg:.1f} degrees",
        frames=len(made.track.frames),
        residual_px=made.residual_px,
        parallax_deg=made.parallax_deg,
    )
    if made.warnings:
        warn(f"this track may be wrong: {'; '.join(made.warnings)}; lay a grid on the ground and look before you trust it")
    if missing:
        warn(f"{out} cannot hold and lacks: {', '.join(missing)}")
