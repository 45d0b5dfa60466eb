"""Render truth for lens blur: sharp pictures with depth and layers, and what a lens of any opening sees, by ray tracing.

    python -m datasets_scripts.render_truth OUT [--scenes fence,leaves,checkers --seed 1 --views 1 --width 640 --height 360 --samples 256]

OUT/SCENE_SEED/view_NN/ holds meta.json (lens, camera, openings, conventions), all_in_focus.exr, depth.exr, layers/NN.exr where a
thin foreground hides what is behind it, truth/OPENING_FOCUS.exr and sheet.png. Finished files are kept, so an interrupted run goes
on where it stopped. It needs Mitsuba 3 (`pip install -e '.[datasets]'`) and LLVM's library (Debian: libllvm19).
"""

from functools import partial

import typer

from datasets_scripts.made_sets.truth_set import SHAPE_NAMES, View, make_views, truth_command
from datasets_scripts.scenes.truth_scenes import SCENES

render_truth = partial(make_views, View)

main = truth_command(render_truth, tuple(SCENES), SHAPE_NAMES)

if __name__ == "__main__":
    typer.run(main)
