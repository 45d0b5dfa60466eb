"""From what the command line says to the lenses, renderers and scenery of a viewfinder."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import BY_NAME, DEFAULT, WITH_BANKS
from mrbokeh.system.errors import InputError
from viewfinder.app.live_compositor import LensBook
from viewfinder.stage.overlay_source import Scenery
from viewfinder.stage.stage import Stage
from viewfinder.stage.stage_setup import LIVE_LAYERING, live_renderer
from viewfinder.stage.static_layer import StillLayer

MakeRenderer = Callable[[], Renderer]


def read_lenses(paths: Sequence[Path], of_scene: Lens | None) -> tuple[LensBook, dict[str, MakeRenderer]]:
    """(lenses by the names of their files, the networks among them as renderers). A network (.onnx) brings its lens."""
    lenses: dict[str, Lens] = {}
    networks: dict[str, MakeRenderer] = {}
    for path in paths:
        if path.suffix.lower() == ".onnx":
            from mrbokeh.renderers.onnx_network import OnnxNetwork

            network = OnnxNetwork(path)
            lenses[path.stem], networks[path.stem] = network.lens, partial(_same, network)
        else:
            lenses[path.stem] = read_lens(path)
    if not lenses and of_scene is not None:
        lenses["scene"] = of_scene
    if not lenses:
        raise InputError("expected a lens, got none: give --lens LENS.json (see `mrbokeh lens new`), or name one in the scene file")
    return LensBook(lenses), networks


def _same(renderer: Renderer) -> Renderer:
    return renderer


def renderers_of(names: Sequence[str], bank: Path | None, networks: dict[str, MakeRenderer]) -> dict[str, MakeRenderer]:
    """What the page can switch between, the first is used first; bank: of measured kernels, for the renderers that take one.

    InputError for a name that nothing has, and for a bank that none of them takes: a mistake is told now, not when the page switches.
    """
    wanted = list(names) or ([*networks, DEFAULT] if networks else [DEFAULT, "scatter"])
    _refuse_unknown(wanted, networks)
    if bank is not None and not set(wanted) & set(WITH_BANKS):
        raise InputError(f"--psf is for --renderer {', '.join(WITH_BANKS)}, got {', '.join(wanted)}: leave --psf out, or name one of them")
    made: dict[str, MakeRenderer] = {}
    for name in wanted:
        if name in networks:
            made[name] = networks[name]
        elif bank is not None and name in WITH_BANKS:
            made[name] = _with_bank(name, bank)
        else:
            made[name] = _plain(name)
    return made


def _refuse_unknown(names: Sequence[str], networks: dict[str, MakeRenderer]) -> None:
    for name in names:
        is_file = name.lower().endswith(".onnx")
        if is_file and not Path(name).is_file():
            raise InputError(f"--renderer: expected a network in an .onnx file, got {name}, where there is no such file")
        if not is_file and name not in networks and name not in BY_NAME:
            raise InputError(f"--renderer: expected one of {', '.join([*networks, *BY_NAME])}, or a network (.onnx), got {name!r}")


def _plain(name: str) -> MakeRenderer:
    return lambda: live_renderer(name)


def _with_bank(name: str, bank: Path) -> MakeRenderer:
    from mrbokeh.renderers.choose import chosen_renderer

    return lambda: chosen_renderer(name, bank, threads=1, layering=LIVE_LAYERING)


def open_scenery(
    scene: Path | None, layer: Path | None, lens_of: Callable[[], Lens], renderers: dict[str, MakeRenderer], backend: str = "auto"
) -> Scenery:
    """Exactly one of scene and layer. The first renderer is used first. backend: what draws the scene (mrbokeh.scene.choose)."""
    name, make = next(iter(renderers.items()))
    if layer is not None:
        from mrbokeh.images.image_io import read_layer

        return StillLayer(read_layer(layer), lens_of(), make(), name)
    assert scene is not None, "checked by the command"
    from mrbokeh.scene.choose import scene_renderer

    stage = Stage(scene, scene_renderer(backend, threads=1))
    stage.set_renderer(name, make())
    return stage
