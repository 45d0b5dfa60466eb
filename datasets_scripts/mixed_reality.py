"""Render truth for virtual objects in defocused photographs: scene alone, object alone, and both traced together through one lens.

    python -m datasets_scripts.mixed_reality OUT [--scenes fence,leaves --seed 1 --views 1 --width 640 --height 360 --samples 256]

The object hangs behind a fence or leaves and before everything else. OUT/SCENE_SEED/view_NN/ holds meta.json (lens, camera, openings,
conventions), scene/all_in_focus.exr, scene/depth.exr, scene/OPENING_FOCUS.exr (the photographs), object.exr (sharp, RGBA and Z),
both/OPENING_FOCUS.exr (the truth) and sheet.png. Finished files are kept, so an interrupted run goes on where it stopped. It needs
Mitsuba 3 (`pip install 'mrbokeh[datasets]'`) and is fast where LLVM's library is installed (Debian: libllvm19).
"""

from pathlib import Path

import typer

from datasets_scripts.mixed_reality_objects import OBJECT_DISTANCES_M
from datasets_scripts.mixed_reality_views import MixedView
from datasets_scripts.truth_plan import TruthPlan
from datasets_scripts.truth_set import make_missing, truth_command
from mrbokeh.system.errors import InputError

DEFAULT_SHAPES = ("disc", "blades7", "cat_eye")


def mixed_reality(out: Path, plan: TruthPlan, *, overwrite: bool = False, variant: str | None = None) -> int:
    """`truth_set.make_missing` of MixedView; raises InputError for scenes without an object too."""
    if set(plan.scenes) - set(OBJECT_DISTANCES_M):
        raise InputError(f"expected scenes out of {','.join(OBJECT_DISTANCES_M)}, got {','.join(plan.scenes)}")
    return make_missing(MixedView, out, plan, overwrite=overwrite, variant=variant)


main = truth_command(mixed_reality, tuple(OBJECT_DISTANCES_M), DEFAULT_SHAPES)

if __name__ == "__main__":
    typer.run(main)
