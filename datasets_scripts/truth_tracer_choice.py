"""A truth tracer by the variant of Mitsuba that it uses; the only module that knows them all."""

from datasets_scripts.truth_mitsuba import LLVM, best_variant, load
from datasets_scripts.truth_scene import PackedScene
from datasets_scripts.truth_tracer import Part, TruthTracer
from mrbokeh.optics.camera import Camera


def make_tracer(scene: PackedScene, camera: Camera, part: Part = "all", seed: int = 0, variant: str | None = None) -> TruthTracer:
    """A tracer in that variant, or in the best one that runs here."""
    chosen = variant or best_variant()
    load(chosen)
    if chosen == LLVM:
        from datasets_scripts.truth_tracer_llvm import LlvmTracer

        return LlvmTracer(scene, camera, part, seed)
    from datasets_scripts.truth_tracer_scalar import ScalarTracer

    return ScalarTracer(scene, camera, part, seed)
