"""Blur a picture with depth by a lens of seven blades, focused on two places.

python examples/blur_a_picture.py OUT_FOLDER
"""

import sys
from pathlib import Path

import numpy as np

import mrbokeh as mb

out = Path(sys.argv[1])
out.mkdir(parents=True, exist_ok=True)

# A floor of tiles that goes away from the camera, and small lamps: linear light, depth in metres.
y, x = np.mgrid[:240, :360].astype(np.float32)
depth_m = 90.0 / (y + 60.0)
tiles = ((x - 180.0) * depth_m // 30.0 + 8.0 * depth_m // 1.0) % 2.0
picture = (0.05 + 0.3 * tiles)[..., None] * np.array([1.0, 0.9, 0.7], np.float32)
picture[20:220:40, 30:350:60] = 40.0

lens = mb.Lens(focal_length_mm=50, f_number=1.4, aperture=mb.Aperture.blades(7))
for name, pixel in (("near", (180, 220)), ("far", (180, 20))):
    blurred = mb.render(picture, depth_m, lens, focus=pixel)
    mb.write_image(out / f"focused_{name}.png", blurred)
