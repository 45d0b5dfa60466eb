"""Lens distortion of the plate's camera, put on virtual layers that a pinhole rendered with overscan.

    from mrbokeh.distortion import LensDistortion, distorted, overscan_camera

    distortion = LensDistortion.of("opencv", k1=-0.12, k2=0.03)
    wide = overscan_camera(plate_camera, distortion)
    layer = distorted(renderer.render(scene, wide), wide, plate_camera, distortion)

What lies where:
    distortion            LensDistortion: distorted_px, undistorted_px; models by name, or an ST map
    models                the polynomials: opencv, fisheye, ptlens, poly3, poly5
    radial_inverse        where a profile folds, and its inverse
    st_map                StMap: read_st_map; u to the right, v upwards, as Nuke writes it
    colmap                colmap_distortion: parameters of COLMAP's camera models
    lensfun_database      lensfun_distortion: by the names of camera and lens (needs lensfunpy)
    distortion_json       to and from the entries of camera files
    overscan              overscan_camera; source_positions_px
    warping               distorted: a layer into the plate's pixels
    resampling            resampled: a layer read at any positions, by areas
"""

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.distortion.warping import distorted, overscan_camera

__all__ = ["LensDistortion", "distorted", "overscan_camera"]
