"""Mitsuba 3 on the processor: its compiled (LLVM) variant, and its scenes of bare triangles."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mrbokeh.system.errors import InputError, MissingExtraError

LLVM = "llvm_ad_rgb"

_PLACES = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")
_PATTERNS = ("libLLVM*", "*/libLLVM*", "llvm-*/lib/libLLVM*")
_TESTED = "19"
# Debian's LLVM 15 crashes on processors with AVX-512.
_CRASHES = ("LLVM-15", "LLVM.so.15")


def load(threads: int = 0) -> Any:
    """Mitsuba with its LLVM variant chosen; threads: 0 leaves the number as it is, which is all cores at first.

    Raises MissingExtraError where Mitsuba is not installed, InputError where there is no LLVM for it.
    """
    library = find_llvm()
    if library is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(library))
    try:
        import drjit
        import mitsuba
    except ImportError:
        raise MissingExtraError("mitsuba", "mitsuba") from None
    try:
        mitsuba.set_variant(LLVM)
        drjit.eval(mitsuba.Float([0.0]) + 1.0)
    except (ImportError, RuntimeError) as error:
        raise InputError(
            f"expected the LLVM library that Mitsuba's path tracer compiles with, but it does not load ({str(error).splitlines()[0]}): "
            "install one (Debian: apt install libllvm19) or name it in DRJIT_LIBLLVM_PATH, or choose the renderer embree"
        ) from None
    if threads:
        drjit.set_thread_count(threads)
    return mitsuba


def find_llvm() -> Path | None:
    """LLVM's shared library: where DRJIT_LIBLLVM_PATH says, else version 19 or, without it, the last by name."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        return Path(named)
    found = [path for place in _PLACES for pattern in _PATTERNS for path in Path(place).glob(pattern)]
    libraries = [path for path in found if path.is_file() and (".so" in path.name or path.suffix == ".dylib")]
    usable = [path for path in libraries if not any(name in path.name for name in _CRASHES)]
    return max(usable, key=lambda path: (_TESTED in path.name, path.name), default=None)


def triangle_scene(corners_m: Float[np.ndarray, "triangles 3 3"]) -> Any:
    """Mitsuba's scene of these triangles alone, in their order; it is asked for intersections only."""
    import mitsuba

    mesh = mitsuba.Mesh("triangles", 3 * len(corners_m), len(corners_m))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = corners_m.astype(np.float32).ravel()
    parameters["faces"] = np.arange(3 * len(corners_m), dtype=np.uint32)
    parameters.update()
    return mitsuba.load_dict({"type": "scene", "triangles": mesh})
