"""A picture of what a lens does to points: kernels and the growth of the circle of confusion."""

from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.lens import Lens

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KERNEL_COC_PX = (-24.0, -8.0, 8.0, 24.0)


def draw_lens(lens: Lens, image_width_px: int) -> "Figure":
    """Kernels at a few signed diameters over a plot of the signed circle of confusion against depth."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    grid = figure.add_gridspec(2, len(KERNEL_COC_PX), height_ratios=(1, 2))
    for column, coc_px in enumerate(KERNEL_COC_PX):
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(lens.aperture.rasterize(coc_px).kernel, cmap="inferno")
        axes.set_title(f"{coc_px:+.0f} px " + ("behind" if coc_px > 0 else "in front"), fontsize=9)
        axes.axis("off")
    axes = figure.add_subplot(grid[1, :])
    dioptres = np.linspace(1.0 / 50.0, min(3.0 / lens.focus_distance_m if np.isfinite(lens.focus_distance_m) else 2.0, 20.0), 400)
    axes.semilogx(1.0 / dioptres, lens.coc_px(1.0 / dioptres, image_width_px))
    axes.axhline(0.0, color="grey", lw=0.5)
    axes.set_xlabel("depth in m")
    axes.set_ylabel(f"circle of confusion in px of {image_width_px}")
    focus = f"{lens.focus_distance_m:g} m" if np.isfinite(lens.focus_distance_m) else "infinity"
    axes.set_title(f"{lens.focal_length_mm:g} mm f/{lens.f_number:g} focused at {focus}, sensor {lens.sensor_width_mm:g} mm")
    return figure
