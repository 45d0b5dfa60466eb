"""Light from drawn points of the environment and of shining triangles (next event estimation), with Mitsuba's compiler."""

from typing import Any

import drjit as dr
import mitsuba as mi

from mrbokeh.scene.mitsuba.reflection import Reflection
from mrbokeh.scene.mitsuba.world import World


def drawn_lights(world: World, reflects: Reflection, sampler: Any, active: Any) -> Any:
    """Radiance reflected from one point drawn of the environment and one of the shining triangles."""
    result = mi.Color3f(0.0)
    if world.environment is not None:
        result += environment_light(world, reflects, sampler, active)
    if world.shining.any:
        value_of = reflects.value
        result += shining_light(world, reflects.surface.origin, value_of, sampler, active)
    return result


def environment_light(world: World, reflects: Reflection, sampler: Any, active: Any) -> Any:
    assert world.environment is not None
    towards, density = world.environment.drawn(sampler.next_2d(active), active)
    value, other_density = reflects.value(towards)
    wanted = active & (dr.max(value) > 0.0) & (density > 0.0)
    arrives = world.open_share(reflects.surface.origin, towards, mi.Float(dr.largest(mi.Float)), wanted)
    weight = balance(density, other_density) / dr.maximum(density, 1e-20)
    return dr.select(wanted, value * world.environment.radiance(towards, wanted) * (arrives * weight), 0.0)


def shining_light(world: World, origin: Any, value_of: Any, sampler: Any, active: Any) -> Any:
    """value_of(direction) -> (BRDF times cosine, density of the other ways in which that direction is drawn)."""
    which, place = world.shining.drawn(sampler.next_1d(active), sampler.next_2d(active), active)
    emitted, towards, distance, density = world.shine(which, place, origin, active)
    value, other_density = value_of(towards)
    wanted = active & (dr.max(value * emitted) > 0.0)
    arrives = world.open_share(origin, towards, distance, wanted)
    weight = balance(density, other_density) / dr.maximum(density, 1e-20)
    return dr.select(wanted, value * emitted * (arrives * weight), 0.0)


def balance(density: Any, other: Any) -> Any:
    """The balance heuristic: what counts of light drawn with one density where another way draws it too."""
    return density / dr.maximum(density + other, 1e-20)
