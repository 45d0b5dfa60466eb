"""A focus plan as a table in the terminal."""

from rich.console import Console
from rich.table import Table

from capture.tether.focus_plan import FocusPlan
from mrbokeh.optics.lens import film_plane_m

_ROUNDING_PX = 1e-6


def print_plan(plan: FocusPlan, console: Console) -> None:
    """Where to focus, from the lens and from the film plane, and what the plan comes to in a few words."""
    table = Table("slice", "from lens (m)", "from film plane (m)", "dioptres", "breathing")
    for index, lens in enumerate(plan.lenses):
        numbers = lens.focus_distance_m, film_plane_m(lens), plan.dioptres[index], plan.breathing[index]
        table.add_row(str(index), *(f"{each:.4f}" for each in numbers))
    console.print(table)
    count = "1 slice" if len(plan) == 1 else f"{len(plan)} slices"
    console.print(f"{count} of {plan.image_width_px} px, largest residual circle of confusion {plan.residual_px:.2f} px")
    console.print(f"largest circle of confusion within the range: {plan.largest_coc_px:.1f} px (what a network has to reach)")
    if plan.residual_px > plan.wanted_residual_px + _ROUNDING_PX:
        console.print(
            f"[yellow]the residual is above the {plan.wanted_residual_px:g} px that were asked for: the steps are too coarse[/yellow]"
        )
