"""One bracket while it is shot: a slice into focus, onto the disk and into the log; the first slice once more at the end."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from capture.tether.camera_driver import Ability, CameraDriver, CameraError
from capture.tether.focus_plan import FocusPlan
from capture.tether.live_reading import read_live
from capture.tether.return_check import check_return
from capture.tether.saved_shot import SavedShot, require_same_exposure, save_shot
from capture.tether.shoot_focus import Focusing
from capture.tether.shoot_log import ShootLog
from capture.tether.shoot_options import ShootOptions, Surroundings
from capture.tether.shoot_sidecar import write_sidecar

CHECK_FOLDER = ".check"
_SAME_LENS = 0.03


@dataclass(frozen=True)
class Bracket:
    """Everything that a shoot has at hand. abilities: of the camera."""

    plan: FocusPlan
    camera: CameraDriver
    abilities: frozenset[Ability]
    focusing: Focusing
    log: ShootLog
    options: ShootOptions
    world: Surroundings

    def take(self, index: int) -> None:
        """One slice. Raises CameraError, which says how much is kept."""
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
        """Slice 0 again, compared with what it was; into the log, and warnings to the photographer."""
        self.focusing.focus_on(0)
        repeated = save_shot(self.camera.capture(), self.log.folder / CHECK_FOLDER, "slice_00_again")
        second = self._path(1) if 1 in self.log.slices else None
        result = check_return(self._path(0), repeated.path, second)
        self.log.check = {"file": f"{CHECK_FOLDER}/{repeated.path.name}", "steps": repeated.shot.steps} | result.to_json()
        self.log.write()
        for warning in result.warnings:
            self.world.say(f"warning: {warning}")

    def lens_remarks(self) -> list[str]:
        """Where the photographs state another lens than the one that was planned for."""
        stated, remarks = self.log.slices[0]["stated"], []
        for name, unit in (("focal_length_mm", " mm"), ("f_number", "")):
            planned, real = getattr(self.plan.lens, name), stated[name]
            if real and abs(real / planned - 1.0) > _SAME_LENS:
                remarks.append(
                    f"the plan is for {name} {planned:g}{unit}, the photographs state {real:g}{unit}: plan again, or set the lens"
                )
        return remarks

    def _require_manual_exposure(self, record: dict[str, Any], saved: SavedShot) -> None:
        """A photograph exposed otherwise than the first is taken back: it would come after others that are right."""
        if not self.log.slices:
            return
        try:
            require_same_exposure(self.log.slices[min(self.log.slices)], record)
        except CameraError:
            saved.path.unlink()
            raise

    def _live(self) -> dict[str, float] | None:
        """Sharpness and exposure as the live view shows them, if there is one; the photograph matters more."""
        if Ability.live_view not in self.abilities:
            return None
        try:
            reading = asdict(read_live(self.camera.preview(), self.options.spot))
        except CameraError:
            return None
        return {name: round(float(reading[name]), 6) for name in ("sharpness", "clipped", "black")}

    def _path(self, index: int) -> Path:
        return self.log.folder / str(self.log.slices[index]["file"])
