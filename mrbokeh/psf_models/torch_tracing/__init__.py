"""Light tracing by torch: on an NVIDIA GPU, or on any processor that torch runs on (models of Leimkuehler et al. 2018, Section 5.1).

Twins of the compiled loops (`_physical_lens_numba` and so on), a step of theirs at a time for all rays of a block. They take the
same quasi-random points, and photons the same random numbers, in double precision and in the same order of operations. A ray
then lands where the compiled one lands but for rounding (torch's square roots, sines and logarithms may differ in the last
bit): within 1e-13 mm behind the double Gauss, so that about one ray in a million million takes the pixel beside. Light is
added up in whole numbers (`_sums`), which come out the same in any order. A bank is therefore the same to float32 on any device,
and a half-built one goes on on another.

What does not grow with the rays stays on the CPU: the points themselves, the search for chief rays and windows, the turning of
rings into pixels.

torch comes with the extra `train`; without it, importing this package says so.
"""

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

from mrbokeh.psf_models.torch_tracing._rays import LandedRays, trace_capsule, trace_lens, trace_picture
from mrbokeh.psf_models.torch_tracing._volume import photons_in_rings, trace_photons

__all__ = ["LandedRays", "photons_in_rings", "trace_capsule", "trace_lens", "trace_photons", "trace_picture"]
