"""Lens distortion of the plate's camera, put on virtual layers that a pinhole rendered with overscan.

    from mrbokeh.distortion import LensDistortion, distorted, overscan_camera

    distortion = LensDistortion.of("opencv", k1=-0.12, k2=0.03)
    wide = overscan_camera(plate_camera, distortion)
    layer = distorted(renderer.render(scene, wide), wide, plate_camera, distortion)

`distortion` holds LensDistortion with its JSON, COLMAP's models and ST maps, `radial` the polynomials and their inverse, `warping` the
overscan and the resampling of layers.
"""

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.distortion.warping import distorted, overscan_camera

__all__ = ["LensDistortion", "distorted", "overscan_camera"]
