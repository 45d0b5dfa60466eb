"""`mrbokeh capture shoot`: one bracket, slice by slice, each on the disk and in the log before the next is taken.

SHOOT/slice_00.nef, ...; shoot.json, the log; lens.toml with what the photographs do not state; .check/ with the first slice
shot again at the end. The folder goes to `mrbokeh capture ingest` as it is.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

from capture.tether.bracket import Bracket
from capture.tether.camera_driver import Ability, CameraDescription, CameraDriver, CameraSettings
from capture.tether.focus_axis import FocusAxis
from capture.tether.focus_plan import FocusPlan
from capture.tether.focus_steps import steps_to_json
from capture.tether.shoot_focus import ByHand, ByMotor, Focusing
from capture.tether.shoot_log import ShootLog, open_log
from capture.tether.shoot_options import ShootOptions, Surroundings
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError


def shoot(plan: FocusPlan, camera: CameraDriver, out: Path, options: ShootOptions, world: Surroundings) -> ShootLog:
    """Take what is missing of the plan. Raises CameraError where the camera fails; run again, it goes on at the first missing slice."""
    description = camera.describe()
    log = open_log(out, plan, description.name, overwrite=options.overwrite)
    if len(log.slices) == len(plan) and (log.check or not options.check):
        world.say(f"all {len(plan)} slices are in {out} already")
        return log
    _configure(camera, options.settings, log)
    focusing = _focusing(plan, camera, description, options, world)
    log.focus_steps = steps_to_json(focusing.steps) if isinstance(focusing, ByMotor) else None
    log.write()
    bracket = Bracket(plan, camera, description.abilities, focusing, log, options, world)
    missing = [index for index in range(len(plan)) if index not in log.slices]
    for index in _shown(missing, focusing):
        bracket.take(index)
    for remark in bracket.lens_remarks():
        world.say(remark)
    if options.check and log.check is None:
        bracket.check()
    return log


def _configure(camera: CameraDriver, settings: CameraSettings, log: ShootLog) -> None:
    """Set up, and see that a shoot that goes on does so with the same settings."""
    now = camera.configure(settings)
    changed = [f"{name} {log.settings[name]}, now {now.get(name)}" for name in log.settings if log.settings[name] != now.get(name)]
    if log.slices and changed:
        raise InputError(f"the slices in {log.folder} were taken with other settings ({'; '.join(changed)}): set these, or --overwrite")
    log.settings = now


def _focusing(
    plan: FocusPlan, camera: CameraDriver, description: CameraDescription, options: ShootOptions, world: Surroundings
) -> Focusing:
    if options.by_hand or Ability.focus_drive not in description.abilities:
        return ByHand(plan, world.ask if Ability.shutter in description.abilities else world.say)
    steps = options.focus_steps or description.focus_steps
    if steps is None:
        raise InputError(
            "what this camera's focus steps mean is not known: measure it with two --target X,Y=METRES, give --near-steps and "
            "--far-steps or --focus-steps FILE, or turn the ring --by-hand"
        )
    axis = FocusAxis(camera, steps.stop, backlash_steps=options.backlash_steps, settle_s=options.settle_s, sleep=world.sleep)
    return ByMotor(plan, axis, steps)


def _shown(missing: list[int], focusing: Focusing) -> Iterable[int] | Iterator[int]:
    """Under a bar, but for somebody who is being talked to."""
    return track(missing, "shooting") if isinstance(focusing, ByMotor) else missing
