"""`mrbokeh capture shoot`: one bracket, slice by slice; each is on the disk and in the log before the next is taken.

SHOOT/slice_00.nef, ...; shoot.json, the log; lens.toml with what the photographs do not state; .check/ with the first slice
shot again at the end. The folder goes to `mrbokeh capture ingest` as it is. The arguments of the command are parsed at the end.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from capture.tether.camera_driver import (
    Ability,
    CameraDescription,
    CameraDriver,
    CameraError,
    CameraSettings,
    FocusSteps,
    Stop,
    steps_to_json,
)
from capture.tether.focus_motor import FocusAxis, Target
from capture.tether.focus_plan import FocusPlan
from capture.tether.live_view import Spot, read_live
from capture.tether.shoot_files import SavedShot, ShootLog, check_return, open_log, require_same_exposure, save_shot, write_sidecar
from mrbokeh.optics.lens import film_plane_m
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

CHECK_FOLDER = ".check"
_SAME_LENS = 0.03


@runtime_checkable
class Focusing(Protocol):
    """A way to focus for each slice: by the camera's motor, or by the photographer's hand."""

    def focus_on(self, index: int) -> float:
        """Focus for a slice and return the dioptres reached, as far as known. Raises CameraError if they cannot be reached."""
        ...


@dataclass(frozen=True)
class ByMotor:
    """Focusing by whole steps of a motor, up to half a step off the plan."""

    plan: FocusPlan
    axis: FocusAxis
    steps: FocusSteps

    def focus_on(self, index: int) -> float:
        wanted = self.steps.steps_at(self.plan.dioptres[index])
        self.axis.move_to(wanted)
        return max(self.steps.dioptre_at(wanted), 0.0)


@dataclass(frozen=True)
class ByHand:
    """Focusing by the photographer, who turns the ring; `ask` shows what to do and returns when it is done."""

    plan: FocusPlan
    ask: Callable[[str], None]

    def focus_on(self, index: int) -> float:
        lens = self.plan.lenses[index]
        self.ask(
            f"slice {index} of 0 to {len(self.plan) - 1}: focus at {film_plane_m(lens):.3f} m on the lens's scale "
            f"({lens.focus_distance_m:.3f} m from the lens), always turning from near to far"
        )
        return self.plan.dioptres[index]


@dataclass(frozen=True)
class ShootOptions:
    """Options of a bracket.

    settings: fixed for all slices. focus_steps: the motor's scale; None asks the camera. by_hand: leave the motor alone.
    backlash_steps, settle_s: see FocusAxis. spot: where the live view's sharpness is read, None for the whole picture.
    check: shoot slice 0 again at the end.
    planned_distances: let lens.toml state the planned focus even if the photographs state their own.
    """

    settings: CameraSettings = field(default_factory=CameraSettings)
    focus_steps: FocusSteps | None = None
    by_hand: bool = False
    backlash_steps: int = 200
    settle_s: float = 0.5
    spot: Spot | None = None
    check: bool = True
    planned_distances: bool = False
    overwrite: bool = False


def _wait_for_enter(text: str) -> None:
    try:
        input(f"{text}. Enter when ready: ")
    except EOFError:
        raise InputError("turning the ring by hand needs somebody at the terminal who presses Enter") from None


@dataclass(frozen=True)
class Surroundings:
    """Terminal and clock of a shoot.

    say: shows a line. ask: shows one and waits until the photographer is ready. sleep: waits some seconds. now: the time.
    """

    say: Callable[[str], None] = print
    ask: Callable[[str], None] = _wait_for_enter
    sleep: Callable[[float], None] = time.sleep
    now: Callable[[], datetime] = datetime.now


@dataclass(frozen=True)
class Bracket:
    """A bracket while it is shot. abilities: of the camera."""

    plan: FocusPlan
    camera: CameraDriver
    abilities: frozenset[Ability]
    focusing: Focusing
    log: ShootLog
    options: ShootOptions
    world: Surroundings

    def take(self, index: int) -> None:
        """Take one slice. Raises CameraError, which says how much is kept."""
        try:
            dioptre = self.focusing.focus_on(index)
            live = self._live()
            saved = save_shot(self.camera.capture(), self.log.folder, f"slice_{index:02d}")
            taken_at = self.world.now().isoformat(timespec="seconds")
            record = {"index": index, "dioptre": dioptre, "taken_at": taken_at, "live": live} | saved.record()
            self._require_manual_exposure(record, saved)
        except CameraError as error:
            raise CameraError(
                f"slice {index} could not be taken: {error}. {len(self.log.slices)} slices are kept in {self.log.folder}: "
                f"the same command goes on"
            ) from None
        self.log.add(record)
        write_sidecar(self.log, self.plan, planned_distances=self.options.planned_distances)

    def check(self) -> None:
        """Shoot slice 0 again, compare it with the first one, log the result and warn the photographer."""
        self.focusing.focus_on(0)
        repeated = save_shot(self.camera.capture(), self.log.folder / CHECK_FOLDER, "slice_00_again")
        second = self._path(1) if 1 in self.log.slices else None
        result = check_return(self._path(0), repeated.path, second)
        self.log.check = {"file": f"{CHECK_FOLDER}/{repeated.path.name}", "steps": repeated.shot.steps} | result.to_json()
        self.log.write()
        for warning in result.warnings:
            self.world.say(f"warning: {warning}")

    def lens_remarks(self) -> list[str]:
        """Return remarks if the photographs state another lens than the planned one."""
        stated, remarks = self.log.slices[0]["stated"], []
        for name, unit in (("focal_length_mm", " mm"), ("f_number", "")):
            planned, real = getattr(self.plan.lens, name), stated[name]
            if real and abs(real / planned - 1.0) > _SAME_LENS:
                remarks.append(
                    f"the plan is for {name} {planned:g}{unit}, the photographs state {real:g}{unit}: plan again, or set the lens"
                )
        return remarks

    def _require_manual_exposure(self, record: dict[str, Any], saved: SavedShot) -> None:
        """Delete a photograph whose exposure differs from the first one's, and raise CameraError."""
        if not self.log.slices:
            return
        try:
            require_same_exposure(self.log.slices[min(self.log.slices)], record)
        except CameraError:
            saved.path.unlink()
            raise

    def _live(self) -> dict[str, float] | None:
        """Return sharpness and exposure of the live view, or None if there is none or it fails; the photograph matters more."""
        if Ability.live_view not in self.abilities:
            return None
        try:
            reading = asdict(read_live(self.camera.preview(), self.options.spot))
        except CameraError:
            return None
        return {name: round(float(reading[name]), 6) for name in ("sharpness", "clipped", "black")}

    def _path(self, index: int) -> Path:
        return self.log.folder / str(self.log.slices[index]["file"])


def shoot(plan: FocusPlan, camera: CameraDriver, out: Path, options: ShootOptions, world: Surroundings) -> ShootLog:
    """Take the missing slices of the plan. Raises CameraError if the camera fails; run again, it continues at the first missing slice."""
    description = camera.describe()
    log = open_log(out, plan, description.name, overwrite=options.overwrite)
    if len(log.slices) == len(plan) and (log.check or not options.check):
        world.say(f"all {len(plan)} slices are in {out} already")
        return log
    _configure(camera, options.settings, log)
    focusing = _focusing(plan, camera, description, options, world)
    log.focus_steps = steps_to_json(focusing.steps) if isinstance(focusing, ByMotor) else None
    log.write()
    bracket = Bracket(plan=plan, camera=camera, abilities=description.abilities, focusing=focusing, log=log, options=options, world=world)
    missing = [index for index in range(len(plan)) if index not in log.slices]
    for index in _shown(missing, focusing):
        bracket.take(index)
    for remark in bracket.lens_remarks():
        world.say(remark)
    if options.check and log.check is None:
        bracket.check()
    return log


def _configure(camera: CameraDriver, settings: CameraSettings, log: ShootLog) -> None:
    """Configure the camera and refuse to continue a shoot with other settings."""
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
    """Show a progress bar, except to a photographer who is being asked to turn the ring."""
    return track(missing, "shooting") if isinstance(focusing, ByMotor) else missing


def steps_between(plan: FocusPlan, near_steps: int | None, far_steps: int | None, home: str) -> FocusSteps | None:
    """Return the scale given by --near-steps and --far-steps for the plan's range, None without them."""
    if near_steps is None and far_steps is None:
        return None
    if near_steps is None or far_steps is None:
        raise InputError("--near-steps and --far-steps belong together: two places give the scale")
    points = ((float(near_steps), 1.0 / plan.range.near_m), (float(far_steps), 1.0 / plan.range.far_m))
    return FocusSteps(parse_stop(home), tuple(sorted(points)))


def parse_stop(text: str) -> Stop:
    if text not in list(Stop):
        raise InputError(f"--home must be one of {', '.join(Stop)}, got {text!r}")
    return Stop(text)


def parse_seconds(text: str | None) -> float | None:
    """Parse "1/60" or "0.5"."""
    try:
        seconds = None if text is None else float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        seconds = 0.0
    if seconds is not None and not seconds > 0.0:
        raise InputError(f"--exposure-time must be seconds such as 1/60 or 0.5, got {text!r}")
    return seconds


def parse_spot(text: str | None) -> Spot | None:
    """Parse "X,Y" in fractions of width and height."""
    if text is None:
        return None
    return Spot(*numbers_in(text, "a place in the picture must be X,Y from 0 to 1, such as 0.5,0.5", (2,)))


def parse_target(text: str) -> Target:
    """Parse "X,Y=METRES"."""
    place, equals, distance = text.partition("=")
    spot = parse_spot(place)
    try:
        distance_m = float(distance)
    except ValueError:
        distance_m = 0.0
    if spot is None or not equals or not distance_m > 0.0:
        raise InputError(f"--target must be X,Y=METRES, such as 0.3,0.5=0.6, got {text!r}")
    return Target(spot, distance_m)


def open_named(name: str, plan: FocusPlan, *, timeout_s: float, focus_level: int, reverse_focus: bool) -> CameraDriver:
    """Open gphoto2, gphoto2:PORT, folder:DIR or simulated."""
    kind, _, rest = name.partition(":")
    if kind == "gphoto2":
        from capture.tether.gphoto2_camera import open_camera

        return open_camera(rest or None, focus_level=focus_level, reverse_focus=reverse_focus)
    if kind == "folder" and rest:
        from capture.tether.watched_folder import WatchedFolder

        return WatchedFolder(Path(rest), timeout_s=timeout_s)
    if name == "simulated":
        from capture.tether.simulated_camera import SimulatedCamera

        return SimulatedCamera.for_plan(plan)
    raise InputError(f"--source must be gphoto2, gphoto2:PORT, folder:DIR or simulated, got {name!r}")
