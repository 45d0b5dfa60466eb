"""LensBook: the lenses that the page can switch between, and the chosen one as it is set now."""

from collections.abc import Mapping
from dataclasses import replace

from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import LensState

F_NUMBERS = (0.95, 1.2, 1.4, 1.8, 2.0, 2.4, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)
_CLOSEST_FOCAL_LENGTHS = 1.5
_SLIDER_FOCAL_LENGTHS = 6.0


class LensBook:
    """lenses: by name, in the order in which the page shows them. One thread chooses, another asks."""

    def __init__(self, lenses: Mapping[str, Lens]) -> None:
        self._lenses = dict(lenses)
        self.chosen = next(iter(self._lenses))

    @property
    def names(self) -> list[str]:
        return list(self._lenses)

    @property
    def lens(self) -> Lens:
        """The chosen one as its file has it."""
        return self._lenses[self.chosen]

    def choose(self, name: str) -> None:
        if name not in self._lenses:
            raise InputError(f"expected one of the lenses {', '.join(self._lenses)}, got {name!r}")
        self.chosen = name

    @property
    def closest_m(self) -> float:
        """Nearer than this the thin lens of that focal length would need more than three times its extension."""
        return _CLOSEST_FOCAL_LENGTHS * self.lens.focal_length_mm / MM_PER_M

    @property
    def slider_dioptres(self) -> tuple[float, float]:
        """From infinity to a fifth of life size, where lenses that are not for macro end; a tap may go nearer."""
        return 0.0, MM_PER_M / (_SLIDER_FOCAL_LENGTHS * self.lens.focal_length_mm)

    @property
    def f_numbers(self) -> list[float]:
        """What the page offers: the lens's own and the full stops that are smaller openings."""
        return sorted({self.lens.f_number, *(each for each in F_NUMBERS if each > self.lens.f_number)})

    def as_set(self, state: LensState) -> Lens:
        """The chosen lens with what is known of it now; a focus that it cannot reach becomes its closest."""
        lens = self.lens
        focus_m = lens.focus_distance_m if state.focus_distance_m is None else max(state.focus_distance_m, self.closest_m)
        return replace(
            lens,
            focus_distance_m=float(focus_m),
            f_number=state.f_number or lens.f_number,
            focal_length_mm=state.focal_length_mm or lens.focal_length_mm,
        )
