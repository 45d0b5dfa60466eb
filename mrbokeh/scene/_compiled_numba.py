"""How every kernel of this folder is compiled: cached on disk, without Python's lock, without counting references."""

from mrbokeh.system.kernels import njit

compiled = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
"""The kernels allocate nothing and the arrays outlive the call, so counting references is needless; it would be atomic,
several hundred times per shading point, and took two thirds of the time (measured with numba 0.68)."""
