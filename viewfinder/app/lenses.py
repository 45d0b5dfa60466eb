"""LensBook: the lenses that the page can switch between, and the chosen one as it is set now."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError
from viewfinder.frames import LensState

F_NUMBERS = (0.95, 1.2, 1.4, 1.8, 2.0, 2.4, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)
_CLOSEST_FOCAL_LENGTHS = 1.5
_SLIDER_FOCAL_LENGTHS = 6.0

MakeRenderer = Callable[[], Renderer]


class LensBook:
    """Lenses by name, in the order in which the page shows them. One thread chooses, another asks."""

    def __init__(self, lenses: Mapping[str, Lens]) -> None:
        self._lenses = dict(lenses)
        self.chosen = next(iter(self._lenses))

    @property
    def names(self) -> list[str]:
        return list(self._lenses)

    @property
    def lens(self) -> Lens:
        """Chosen lens as its file has it."""
        return self._lenses[self.chosen]

    def choose(self, name: str) -> None:
        if name not in self._lenses:
            raise InputError(f"expected one of the lenses {', '.join(self._lenses)}, got {name!r}")
        self.chosen = name

    @property
    def closest_m(self) -> float:
        """Closest focus: nearer, a thin lens of that focal length would need more than three times its extension."""
        return _CLOSEST_FOCAL_LENGTHS * self.lens.focal_length_mm / MM_PER_M

    @property
    def slider_dioptres(self) -> tuple[float, float]:
        """Ends of the focus slider: infinity, and 1/5 of life size, where lenses that are not for macro end; a tap may go nearer."""
        return 0.0, MM_PER_M / (_SLIDER_FOCAL_LENGTHS * self.lens.focal_length_mm)

    @property
    def f_numbers(self) -> list[float]:
        """F-numbers that the page offers: the lens's own and the full stops that are smaller openings."""
        return sorted({self.lens.f_number, *(each for each in F_NUMBERS if each > self.lens.f_number)})

    def as_set(self, state: LensState) -> Lens:
        """Return the chosen lens with what is known of it now; a focus that it cannot reach becomes its closest."""
        lens = self.lens
        focus_m = lens.focus_distance_m if state.focus_distance_m is None else max(state.focus_distance_m, self.closest_m)
        return replace(
            lens,
            focus_distance_m=float(focus_m),
            f_number=state.f_number or lens.f_number,
            focal_length_mm=state.focal_length_mm or lens.focal_length_mm,
        )


def read_lenses(paths: Sequence[Path], scene: Path | None) -> tuple[LensBook, dict[str, MakeRenderer]]:
    """Read lenses by the names of their files, or that of the scene file; (lenses, the networks among the files as renderers).

    A network (.onnx) brings its lens.
    """
    lenses: dict[str, Lens] = {}
    networks: dict[str, MakeRenderer] = {}
    lens_of_scene = None if scene is None else _lens_of_scene(scene)
    for path in paths:
        if path.suffix.lower() == ".onnx":
            from mrbokeh.renderers.onnx_network import OnnxNetwork

            network = OnnxNetwork(path)
            lenses[path.stem], networks[path.stem] = network.lens, partial(_same, network)
        else:
            lenses[path.stem] = read_lens(path)
    if not lenses and lens_of_scene is not None:
        lenses["scene"] = lens_of_scene
    if not lenses:
        raise InputError("expected a lens, got none: give --lens LENS.json (see `mrbokeh lens new`), or name one in the scene file")
    return LensBook(lenses), networks


def _lens_of_scene(scene: Path) -> Lens | None:
    from mrbokeh.scene.staging.scene_file import read_scene_file

    path = read_scene_file(scene).lens
    return None if path is None else read_lens(path)


def _same(renderer: Renderer) -> Renderer:
    return renderer
