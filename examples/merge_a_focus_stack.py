"""Merge a focus stack into one sharp picture with depth, and put an object into one of its slices.

python examples/merge_a_focus_stack.py OUT_FOLDER [PHOTOGRAPHS_FOLDER]
"""

import sys
from pathlib import Path

import mrbokeh as mb

SHIPPED = Path(mb.__file__).parent / "demo_data"

out = Path(sys.argv[1])
photographs = Path(sys.argv[2]) if len(sys.argv) > 2 else SHIPPED / "pcb_oblique"
merged = mb.merge(photographs, out / "scene")
mb.write_image(out / "all_in_focus.png", merged.all_in_focus)
metres = "metres" if merged.metres_known else "guessed metres"
print(f"{merged.folder}: {merged.depth_m.min():.3g} to {merged.depth_m.max():.3g} {metres}")

height_px, width_px = merged.depth_m.shape
standing_at = (width_px * 2 // 5, height_px * 3 // 5)
cake = SHIPPED / "objects" / "cakeBirthday.glb"
picture = mb.composite(merged.folder, cake, slice_index=2, at_pixel=standing_at, height=f"{height_px // 4}px")
mb.write_image(out / "with_cake.png", picture)
