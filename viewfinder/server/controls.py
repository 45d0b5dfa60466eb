"""Controls: what a page may ask of the viewfinder; the pipeline implements it, the page's messages arrive here."""

from typing import Protocol, TypedDict, runtime_checkable

VIEWS = ("final", "plate", "virtual", "matte", "depth", "coc")


class ObjectState(TypedDict):
    """An object of the scene, by the name under which messages call it."""

    name: str
    visible: bool


class State(TypedDict, total=False):
    """What the page shows; what is missing is not offered. Distances in metres, None is infinity.

    dioptre_range: the ends of the focus slider, (far, near), 1/m. focus_from: who told the focus, None where nobody did and the lens's
    file holds. f_numbers: what may be set, ascending. lens, renderer, view: which of
    lenses, renderers, views is on. ground_from_picture: (3, 3) homography from the picture (x right, y down, 0 to 1) to metres on the
    plane on which objects stand, (x, z) of `move_object`, as nested lists; None while nothing is tracked. can_record, can_capture: whether
    the buttons are shown. failure: a sentence if the source died.
    """

    source: str
    width_px: int
    height_px: int
    dioptre_range: tuple[float, float]
    focus_distance_m: float | None
    focus_from: str | None
    f_number: float
    f_numbers: list[float]
    lens: str
    lenses: list[str]
    renderer: str
    renderers: list[str]
    view: str
    views: list[str]
    objects: list[ObjectState]
    ground_from_picture: list[list[float]] | None
    can_capture: bool
    can_record: bool
    recording: bool
    smoothing: bool | None
    failure: str | None


@runtime_checkable
class Controls(Protocol):
    """All but `state` are called one at a time in a thread of their own and may take their time; InputError says what cannot be."""

    def focus_at_distance(self, metres: float) -> None:
        """inf is allowed."""

    def focus_at_point(self, x: float, y: float) -> float:
        """Focus on what the picture shows at (x, y), right and down from 0 to 1; the metres found."""
        ...

    def set_f_number(self, f_number: float) -> None: ...

    def set_lens(self, name: str) -> None: ...

    def set_renderer(self, name: str) -> None: ...

    def set_view(self, name: str) -> None: ...

    def move_object(self, name: str, xz_m: tuple[float, float]) -> None:
        """By so many metres on the ground plane."""

    def show_object(self, name: str, visible: bool) -> None: ...

    def capture(self) -> str:
        """Save what is seen now; the name of the bundle."""
        ...

    def record(self, on: bool) -> None: ...

    def smooth(self, on: bool) -> None: ...

    def state(self) -> State:
        """Must return at once, from any thread."""
        ...
