"""Mitsuba 3 in the variant that this machine can run: LLVM where its library is there, else the slow scalar one."""

import importlib
import os
from typing import Any

import numpy as np
from jaxtyping import Float32, Int

from mrbokeh.scene.mitsuba.mitsuba_tracer import find_llvm
from mrbokeh.system.errors import InputError, MissingExtraError

LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
VARIANTS = (LLVM, SCALAR)


def best_variant() -> str:
    """LLVM where there is a library for it."""
    return SCALAR if find_llvm() is None else LLVM


def load(variant: str) -> Any:
    """Mitsuba's module of one variant; several may live side by side.

    Raises MissingExtraError where Mitsuba is not installed, InputError where this variant does not run.
    """
    library = find_llvm()
    if library is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(library))
    try:
        importlib.import_module("mitsuba")
    except ImportError:
        raise MissingExtraError("mitsuba", "datasets") from None
    try:
        return importlib.import_module(f"mitsuba.{variant}")
    except ImportError as error:
        raise InputError(f"Mitsuba's variant {variant} does not run here: {error}. One of {', '.join(VARIANTS)} may do") from None


def scene_of(variant: str, vertices_m: Float32[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]) -> Any:
    """Mitsuba's scene of these triangles alone, in their order; it is asked for intersections only."""
    load(variant)
    import mitsuba

    mitsuba.set_variant(variant)
    used, renumbered = np.unique(triangles, return_inverse=True)
    mesh = mitsuba.Mesh("triangles", len(used), len(triangles))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = vertices_m[used].ravel()
    parameters["faces"] = renumbered.ravel().astype(np.uint32)
    parameters.update()
    return mitsuba.load_dict({"type": "scene", "triangles": mesh})
