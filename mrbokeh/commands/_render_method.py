"""How `mrbokeh render` blurs: the renderer with its bank of PSFs, and the lens with its focus."""

from pathlib import Path

from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError


def reconstructed(renderer: Renderer, method: str, samples: Path, lens: Lens) -> Layer:
    """A picture from noisy samples, by a renderer that takes them."""
    from mrbokeh.stacks.light_field_samples_file import read_samples

    if not hasattr(renderer, "reconstruct"):
        raise InputError(f"--samples are for --method lrdm or laplacian, got --method {method}")
    return renderer.reconstruct(read_samples(samples), lens)


def focused(lens: Lens, sharp: dict[str, Layer], focus_distance_m: float | None, focus_at: str | None) -> Lens:
    """The lens at the distance that was asked for, or focused on what is frontmost at a pixel."""
    if focus_distance_m is not None and focus_at is not None:
        raise InputError("give either --focus or --focus-at, not both")
    if focus_distance_m is not None:
        return lens.focused_at(focus_distance_m)
    if focus_at is None:
        return lens
    try:
        x_px, y_px, radius_px = (*map(int, focus_at.split(",")), 0)[:3]
    except ValueError:
        raise InputError(f"--focus-at: expected X,Y or X,Y,RADIUS in whole pixels, got {focus_at!r}") from None
    return lens.focused_on(flatten(list(sharp.values())).depth_m, x_px + 0.5, y_px + 0.5, float(radius_px))
