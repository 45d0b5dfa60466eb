"""`mrbokeh capture matchmove`: the camera of every frame of a clip, from the clip alone."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.atomic_files import refuse_existing

HELP = "\n\n".join(
    (
        "Find the camera of every frame of a clip with COLMAP: keyframes are chosen by motion and placed, then all frames against them.",
        "The scale is arbitrary unless a printed board of known size is in the clip (--board). A camera that only turns, or a scene "
        "that moves by itself, is refused. Keyframes and COLMAP's files stay in --work, with which an interrupted run goes on.",
        "Example:  mrbokeh capture matchmove clip.mp4 --out track.json",
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
    work: Annotated[Path | None, typer.Option(metavar="DIR", help="folder for COLMAP; default: beside OUT")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the track, and find poses again from the start")] = False,
) -> None:
    from capture.matchmove.clip_matchmove import MatchmoveSettings, matchmove_clip
    from mrbokeh.camera_track.formats import write_track
    from mrbokeh.charuco.board_file import read_board

    refuse_existing(out, overwrite)
    printed = None if board is None else read_board(board)
    settings = MatchmoveSettings(keyframes, camera_model, mapper, max_image_size, printed, overwrite)
    made = matchmove_clip(clip, work or out.with_name(f"{out.stem}_matchmove"), settings)
    missing = write_track(out, made.track)
    scale = "in metres, by the board" if made.track.metric else "scale arbitrary"
    lost = f", {len(made.lost)} lost ({', '.join(map(str, made.lost[:8]))}{', ...' if len(made.lost) > 8 else ''})" if made.lost else ""
    typer.echo(
        f"{out}: {len(made.track.frames)} of {made.frame_count} frames from {len(made.model.views)} keyframes{lost}; {scale}; "
        f"residual {made.residual_px:.2f} px RMS, median parallax {made.parallax_deg:.1f} degrees"
    )
    if made.doubts:
        typer.echo(
            f"warning: this track may be wrong: {'; '.join(made.doubts)}; lay a grid on the ground and look before you trust it", err=True
        )
    if missing:
        typer.echo(f"{out} cannot hold and lacks: {', '.join(missing)}", err=True)
