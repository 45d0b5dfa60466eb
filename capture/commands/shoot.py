"""`mrbokeh capture shoot`: a focus bracket with a tethered camera."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, tell

if TYPE_CHECKING:
    from capture.tether.camera_driver import CameraDriver, FocusSteps
    from capture.tether.focus_motor import Target
    from capture.tether.live_view import Spot

HELP = "\n\n".join(
    (
        "Shoot a planned focus bracket: each slice is on the disk and in shoot.json before the next is taken.",
        "--source gphoto2 is a camera on USB (gphoto2:PORT if there are several), folder:DIR a folder into which the camera's own "
        "software or a card stores while you focus and release, simulated a thin lens in memory that shows how all this works.",
        "Exposure must be manual; RAW, a fixed white balance and autofocus off are set where the camera allows. "
        "Interrupted (Ctrl-C, cable, battery), the same command goes on at the first missing slice.",
        "The focus motor: cameras move by steps and tell no position. The lens is driven to its end stop (--home), steps are counted "
        "from there, and every slice is approached moving away from it, so that the play of the gears does not matter. What the steps "
        "mean is told by --near-steps and --far-steps (counted from the stop: where the plan's near and far are in focus), by an "
        "earlier --focus-steps FILE, or measured: put things with detail at two known distances (metres from the lens) and name "
        "their places with --target X,Y=METRES (shares of width and height); the focus is swept once, and OUT/focus_steps.json keeps "
        "the scale. It holds for this lens and body.",
        "At the end slice 0 is shot again and compared: whether focus, frame and light came back.",
        "OUT goes to `mrbokeh capture ingest` as it is; a lens.toml is written with what the photographs do not state.",
        "Example:  mrbokeh capture shoot --plan plan.json --source simulated --out session/view_0",
        "Example:  mrbokeh capture shoot --plan plan.json --source gphoto2 --out session/view_0 --target 0.3,0.5=0.6 "
        "--target 0.7,0.5=2.5 --exposure-time 1/60 --iso 100",
    )
)


def shoot_command(
    plan: Annotated[Path, typer.Option(metavar="plan.json", help="what `mrbokeh capture plan --out` wrote")],
    source: Annotated[str, typer.Option(metavar="CAMERA", help="gphoto2, gphoto2:PORT, folder:DIR or simulated")],
    out: Annotated[Path, typer.Option(metavar="OUT", help="folder of this bracket; one for each viewpoint")],
    exposure_time: Annotated[str | None, typer.Option(metavar="S", help="seconds, such as 1/60; else what the camera has")] = None,
    iso: Annotated[float | None, typer.Option(min=1, max=1e7, help="ISO; else what the camera has")] = None,
    f_number: Annotated[float | None, typer.Option(help="f-number; else what the camera has")] = None,
    white_balance: Annotated[str | None, typer.Option(metavar="WORD", help="in the camera's words, such as Daylight")] = None,
    focus_steps: Annotated[Path | None, typer.Option(metavar="FILE", help="focus_steps.json of an earlier shoot with this lens")] = None,
    near_steps: Annotated[int | None, typer.Option(help="steps from the stop to the plan's near distance")] = None,
    far_steps: Annotated[int | None, typer.Option(help="steps from the stop to the plan's far distance")] = None,
    target: Annotated[
        list[str] | None, typer.Option(metavar="X,Y=M", help="measure the steps: a place and its distance; twice or more")
    ] = None,
    sweep_step: Annotated[int, typer.Option(min=1, help="steps between two readings of that measurement")] = 50,
    home: Annotated[str, typer.Option(help="end stop to count from: near or infinity")] = "near",
    backlash: Annotated[int, typer.Option(min=0, help="at least the play of the focus gears, in steps")] = 200,
    settle: Annotated[float, typer.Option(min=0.0, metavar="S", help="seconds to wait after the lens has moved")] = 0.5,
    by_hand: Annotated[bool, typer.Option("--by-hand", help="say where to turn the ring instead of driving a motor")] = False,
    live: Annotated[bool, typer.Option("--live", help="first show sharpness and exposure of the live view, until Enter")] = False,
    spot: Annotated[str | None, typer.Option(metavar="X,Y", help="where the sharpness is read; else the whole picture")] = None,
    focus_level: Annotated[int, typer.Option(min=1, max=3, help="Canon: size of the steps, 1 to 3")] = 1,
    reverse_focus: Annotated[bool, typer.Option("--reverse-focus", help="if the motor runs the wrong way")] = False,
    timeout: Annotated[float, typer.Option(metavar="S", help="folder: how long to wait for a photograph")] = 600.0,
    check: Annotated[bool, typer.Option("--check/--no-check", help="shoot slice 0 again at the end and compare")] = True,
    planned_distances: Annotated[
        bool, typer.Option("--planned-distances", help="lens.toml states the planned focus even where the photographs state theirs")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="shoot everything again")] = False,
) -> None:
    from capture.tether.camera_driver import CameraSettings, read_focus_steps
    from capture.tether.focus_plan import read_plan
    from capture.tether.shoot import ShootOptions, Surroundings, open_named, parse_seconds, parse_spot, parse_target, shoot, steps_between
    from mrbokeh.system.console import kept_when_interrupted

    planned = read_plan(plan)
    given = read_focus_steps(focus_steps) if focus_steps is not None else steps_between(planned, near_steps, far_steps, home)
    targets = [parse_target(each) for each in target or []]
    if given is not None and targets:
        raise InputError("what the steps mean is both given and to be measured: leave --target out, or the others")
    settings = CameraSettings(parse_seconds(exposure_time), iso, f_number, white_balance)
    driver = open_named(source, planned, timeout_s=timeout, focus_level=focus_level, reverse_focus=reverse_focus)
    with kept_when_interrupted(f"what was shot is kept in {out}", overwrite), closing(driver):
        if live:
            watch(driver, parse_spot(spot))
        if targets:
            given = measured(driver, targets, out, home=home, backlash=backlash, settle=settle, step=sweep_step, again=overwrite)
        options = ShootOptions(
            settings=settings,
            focus_steps=given,
            by_hand=by_hand,
            backlash_steps=backlash,
            settle_s=settle,
            spot=parse_spot(spot),
            check=check,
            planned_distances=planned_distances,
            overwrite=overwrite,
        )
        log = shoot(planned, driver, out, options, Surroundings(say=say))
    tell(f"{len(log.slices)} slices in {out}. Next: mrbokeh capture ingest {out} --out SCENE")


def watch(driver: "CameraDriver", spot: "Spot | None") -> None:
    """Show the live view until Enter."""
    from rich.console import Console

    from capture.tether.live_view import enter_pressed, show_live

    show_live(driver, enter_pressed(), Console(stderr=True), spot)


def measured(
    driver: "CameraDriver", targets: list["Target"], out: Path, *, home: str, backlash: int, settle: float, step: int, again: bool
) -> "FocusSteps":
    """Sweep the focus over targets; the scale is kept in OUT/focus_steps.json and taken from there when a shoot goes on."""
    from capture.tether.camera_driver import read_focus_steps, write_focus_steps
    from capture.tether.focus_motor import FocusAxis, measure_focus_steps
    from capture.tether.shoot import parse_stop
    from mrbokeh.system.console import working

    path = out / "focus_steps.json"
    if path.exists() and not again:
        return read_focus_steps(path)
    axis = FocusAxis(driver, parse_stop(home), backlash_steps=backlash, settle_s=settle)
    with working("measuring what the steps of the motor mean"):
        steps = measure_focus_steps(axis, driver, targets, step=step)
    write_focus_steps(path, steps)
    say(f"{steps.dioptres_per_step:.3g} dioptres per step, kept in {path}")
    return steps
