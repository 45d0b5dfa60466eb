"""Put a layer of your own into a photograph, behind what stands blurred in front of it.

python examples/object_in_a_photograph.py OUT_FOLDER
"""

import sys
from pathlib import Path

import numpy as np

import mrbokeh as mb

out = Path(sys.argv[1])
out.mkdir(parents=True, exist_ok=True)
height_px, width_px = 200, 300

# The photograph: a sharp wall at 3 m, and a post at 0.6 m which the lens has blurred.
rng = np.random.default_rng(0)
wall = mb.Layer(
    rng.uniform(0.05, 0.3, (height_px, width_px, 3)).astype(np.float32),
    np.ones((height_px, width_px), np.float32),
    np.full((height_px, width_px), 3.0, np.float32),
)
depth_m = wall.depth_m.copy()
depth_m[:, 130:170] = 0.6
all_in_focus = wall.rgb.copy()
all_in_focus[:, 130:170] = (0.5, 0.1, 0.05)
lens = mb.Lens(focal_length_mm=50, f_number=2.8, focus_distance_m=3.0)
photo = mb.render(all_in_focus, depth_m, lens)

# A white ball of light at 1.5 m, half behind the post: colour is premultiplied by alpha.
y, x = np.mgrid[:height_px, :width_px]
alpha = (np.hypot(x - 170, y - 100) < 45).astype(np.float32)
ball = mb.Layer(alpha[..., None] * np.float32(0.9) * np.ones(3, np.float32), alpha, np.where(alpha > 0, 1.5, np.inf).astype(np.float32))

picture = mb.composite(photo, ball, lens, depth_m=depth_m, all_in_focus=all_in_focus)
mb.write_image(out / "photograph.png", photo)
mb.write_image(out / "with_ball.png", picture)
