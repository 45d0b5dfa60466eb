"""The frames of `mrbokeh video`: cut to a box and kept from frame to frame they are what the whole frame made anew gives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import Inserted, Plate, plate_of
from mrbokeh.distortion import LensDistortion
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.image_io import write_layer
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import with_motion
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import write_lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.renderers.scatter_reference import ScatterReference
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.staging.filming import Filming
from mrbokeh.shots.composite_recipe import BoxedInsertion, CompositeRecipe
from mrbokeh.shots.frame_sources import DepthFiles, FocusPulled
from mrbokeh.shots.inputs import Description, Kept, LayerSource, Moment
from mrbokeh.shots.layer_sources import LayerFiles, SceneLayers
from mrbokeh.system.errors import InputError
from tests.support.stage_scenes import ONE_CARD, camera, scene_file

LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=2.0, sensor_width_mm=8.0)
WIDTH, HEIGHT = 224, 160


class Counting:
    """A renderer that counts how often it is asked, and for how many pixels."""

    def __init__(self, renderer: ScatterReference | PolygonDifferences) -> None:
        self._renderer, self.sizes = renderer, []  # type: ignore[var-annotated]

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:
        self.sizes.append(layers[0].alpha.shape)
        return self._renderer.render(layers, lens)


def texture(depth_m: float = 1.2, box: tuple[int, int, int, int] = (50, 80, 90, 130)) -> Layer:
    """Noise with holes in it, at one depth or leaning."""
    rng, alpha = np.random.default_rng(4), np.zeros((HEIGHT, WIDTH), np.float32)
    top, bottom, left, right = box
    alpha[top:bottom, left:right] = rng.random((bottom - top, right - left)) > 0.2
    rgb = alpha[..., None] * rng.random((HEIGHT, WIDTH, 3), np.float32)
    lean = np.linspace(0.9, 1.4, WIDTH, dtype=np.float32)[None] * np.float32(depth_m)
    return Layer(rgb.astype(np.float32), alpha, np.where(alpha > 0, lean, np.float32(np.inf)).astype(np.float32))


def photo() -> np.ndarray:
    return np.random.default_rng(9).random((HEIGHT, WIDTH, 3), np.float32)


@pytest.mark.parametrize("renderer", [ScatterReference(threads=1), PolygonDifferences(threads=1)], ids=["scatter", "polygon"])
@pytest.mark.parametrize("kind", ["plain", "depth", "moving", "border"])
def test_a_box_gives_what_the_whole_frame_gives(renderer: ScatterReference | PolygonDifferences, kind: str) -> None:
    """Kernels are the same; sums in single precision of another area are off by some 1e-6 of the strongest light."""
    layer = texture(box=(0, 40, 190, 224)) if kind == "border" else texture()
    if kind == "moving":
        layer = with_motion(layer, np.full((HEIGHT, WIDTH, 2), (14.0, -6.0), np.float32))
    depth_m = np.where(np.arange(WIDTH) < 110, 1.0, 3.0)[None].repeat(HEIGHT, 0).astype(np.float32) if kind == "depth" else None
    plate, counting = plate_of(photo(), LENS, depth_m), Counting(renderer)
    part = BoxedInsertion(OverPhotograph(), counting, local=True).insert(plate, [layer])
    whole = OverPhotograph().insert(plate, [layer], renderer)
    assert counting.sizes[0] < (HEIGHT, WIDTH)
    np.testing.assert_allclose(part.over(plate.rgb), whole.rgb, atol=2e-5)
    mended = part.whole(plate.rgb)
    np.testing.assert_allclose(mended.virtual.alpha, whole.virtual.alpha, atol=2e-5)
    np.testing.assert_allclose(mended.photo_rgb + mended.virtual.rgb, whole.rgb, atol=2e-5)
    untouched = (whole.virtual.alpha == 0) & (whole.virtual.rgb == 0).all(axis=2)
    assert untouched.mean() > 0.2
    np.testing.assert_array_equal(part.over(plate.rgb)[untouched], plate.rgb[untouched])


def test_effects_of_the_field_get_the_whole_frame_and_nothing_to_see_leaves_it() -> None:
    """Cat's eyes depend on the place in the picture; so does the corner of a box."""
    lens = replace(LENS, aperture=replace(LENS.aperture, cat_eye=0.5))
    counting = Counting(ScatterReference(threads=1))
    part = BoxedInsertion(OverPhotograph(), counting, local=True).insert(plate_of(photo(), lens), [texture()])
    assert part.box is None and counting.sizes == [(HEIGHT, WIDTH)]
    empty = texture(box=(5, 5, 5, 5))
    plate = plate_of(photo(), LENS)
    part = BoxedInsertion(OverPhotograph(), ScatterReference(), local=True).insert(plate, [empty])
    np.testing.assert_array_equal(part.over(plate.rgb), plate.rgb)
    assert part.whole(plate.rgb).virtual.alpha.max() == 0


def test_blur_is_redone_only_where_something_changed_and_kept_for_what_was_given() -> None:
    counting, layer, moved = Counting(ScatterReference(threads=1)), texture(), texture(box=(20, 60, 10, 60))
    boxed, depth_m = BoxedInsertion(OverPhotograph(), counting, local=True), np.full((HEIGHT, WIDTH), 9.0, np.float32)
    steps = [(LENS, layer, None, 1), (LENS, layer, None, 1), (LENS.focused_at(1.5), layer, None, 2), (LENS, moved, None, 3)]
    steps += [(LENS, moved, depth_m, 4), (LENS, moved, depth_m, 4), (LENS, moved, depth_m.copy(), 5)]
    for lens, each, depth, expected in steps:
        plate = plate_of(photo(), lens, depth)
        result = boxed.insert(plate, [each]).over(plate.rgb)
        np.testing.assert_allclose(result, OverPhotograph().insert(plate, [each], ScatterReference(threads=1)).rgb, atol=2e-6)
        assert len(counting.sizes) == expected
    calls: list[object] = []
    kept = Kept(lambda each, number: calls.append(each) or (each, number))
    one, other = [1, 2], {"a": 1}
    assert kept(other, 1) is kept(other, 1)
    assert kept(dict(other), 1) == (other, 1) and len(calls) == 2, "equal, but another object"
    assert kept(other, 2) == (other, 2) and len(calls) == 3
    assert kept([one], 1) is kept([one], 1), "a list made anew of the same things"


@pytest.fixture
def files(tmp_path: Path) -> CompositeRecipe:
    write_lens(tmp_path / "lens.json", LENS)
    write_layer(tmp_path / "layer.exr", texture(), half=False)
    return CompositeRecipe(tmp_path / "lens.json", (LayerFiles(tmp_path / "layer.exr"),), renderer="scatter")


def test_a_still_is_read_and_blurred_once(files: CompositeRecipe, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    plain = ScatterReference.render
    monkeypatch.setattr(ScatterReference, "render", lambda self, layers, lens: calls.append(1) or plain(self, layers, lens))
    maker = files.build(1)
    assert isinstance(files.layers[0], Description) and isinstance(files.layers[0].opened(1), LayerSource)
    pictures = [maker.make(index, photo() * (index + 1), index / 25) for index in range(3)]
    assert len(calls) == 1
    plate = plate_of(photo() * 2, LENS)
    np.testing.assert_allclose(pictures[1], OverPhotograph().insert(plate, [texture()], ScatterReference()).rgb, atol=1e-5)
    (Path(files.lens).parent / "layer.exr").unlink()
    assert files.files == (files.lens, files.lens.parent / "layer.exr")


def test_frames_do_not_depend_on_those_before(files: CompositeRecipe) -> None:
    """A segment may begin anywhere: frame 7 is frame 7 whether 0 to 6 were made before or not."""
    recipe = replace(files, focus=FocusPulled("0:1.0,9:4.0"))
    maker = recipe.build(1)
    in_order = [maker.make(index, photo(), index / 25) for index in range(8)]
    np.testing.assert_array_equal(recipe.build(1).make(7, photo(), 7 / 25), in_order[7])
    assert np.abs(in_order[7] - in_order[0]).max() > 0.05


@dataclass(frozen=True)
class Darker:
    """Description and finisher in one."""

    files = ()

    def opened(self, threads: int) -> "Darker":  # noqa: ARG002
        return self

    def finished(self, inserted: Inserted, plate: Plate, number: int) -> Inserted:
        assert plate.rgb.shape == inserted.photo_rgb.shape == (HEIGHT, WIDTH, 3)
        return replace(inserted, virtual=replace(inserted.virtual, rgb=inserted.virtual.rgb * np.float32(0.5**number)))


def test_a_finisher_gets_whole_frames_and_numbers(files: CompositeRecipe) -> None:
    plain = OverPhotograph().insert(plate_of(photo(), LENS), [texture()], ScatterReference())
    made = replace(files, look=Darker(), first_number=1).build(1).make(2, photo(), 0.0)
    np.testing.assert_allclose(made, plain.photo_rgb + 0.125 * plain.virtual.rgb, atol=1e-5)
    virtual = replace(files, look=Darker(), virtual_only=True).build(1).make(1, photo(), 0.0)
    assert isinstance(virtual, Layer)
    np.testing.assert_allclose(virtual.rgb, 0.5 * plain.virtual.rgb, atol=1e-5)


class Cameras:
    """One camera per frame; while the shutter is open it stands still."""

    def __init__(self, *cameras: Camera) -> None:
        self._cameras = cameras

    def camera_at(self, moment: Moment, after_s: float = 0.0) -> Camera:  # noqa: ARG002
        return self._cameras[moment.number]


def test_a_scene_is_rendered_again_only_where_camera_or_scene_move(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    calls: list[int] = []
    plain = EmbreeRaycaster.render
    monkeypatch.setattr(EmbreeRaycaster, "render", lambda self, scene, seen: calls.append(1) or plain(self, scene, seen))
    path = scene_file(tmp_path, ONE_CARD)
    source = SceneLayers(path, Filming("embree")).opened(1)
    seen = camera()
    moments = [Moment(i, i / 25, (seen.width_px, seen.height_px)) for i in range(3)]
    cameras = Cameras(seen, camera(), camera((0.05, 1.0, -0.1), (0.05, 0.0, -0.1)))
    first, second = source.layers_at(moments[0], cameras), source.layers_at(moments[1], cameras)
    assert second[0] is first[0] and len(calls) == 1
    moved = source.layers_at(moments[2], cameras)
    assert len(calls) == 2
    # 50 mm to the right at 1 m move the card by 0.05 * 150 = 7.5 px to the left.
    centres = [np.average(np.arange(seen.width_px), weights=layers[0].alpha.sum(axis=0)) for layers in (first, moved)]
    assert centres[0] - centres[1] == pytest.approx(7.5, abs=0.1)
    # A barrel of 10 % at the unit of the focal length (150 px) draws the card's centre towards the middle, never away from it.
    barrel = Filming("embree", distortion=LensDistortion.of("opencv", k1=-0.1))
    bent = SceneLayers(path, barrel).opened(1).layers_at(moments[0], cameras)
    assert 0.9 * first[0].alpha.sum() < bent[0].alpha.sum() < first[0].alpha.sum()
    assert set(SceneLayers(path).files) == {path, tmp_path / "card.glb"}


def test_steady_depth_begins_anywhere(tmp_path: Path) -> None:
    """Noise of 1 % on a plane at 2 m; the filter starts 48 frames before, which its memory of 24 has forgotten but for exp(-2)."""
    rng = np.random.default_rng(3)
    for number in range(60):
        write_exr(tmp_path / f"d.{number:03d}.exr", ExrPart({"Z": (2.0 * (1 + 0.01 * rng.standard_normal((24, 32)))).astype(np.float32)}))
    described = DepthFiles(tmp_path / "d.%03d.exr", steady=True)
    in_order, there = described.opened(1), described.opened(1)
    for number in range(58):
        before = in_order.depth_m_at(Moment(number, 0.0, (32, 24)))
    # A pixel in a hundred or fewer passed the filter's gate before that: it may have a history of its own.
    assert (np.abs(there.depth_m_at(Moment(57, 0.0, (32, 24))) / before - 1) < 0.002).mean() > 0.99
    raw = DepthFiles(tmp_path / "d.%03d.exr").opened(1).depth_m_at(Moment(57, 0.0, (32, 24)))
    assert np.std(before) < 0.4 * np.std(raw)
    # A filter that begins at frame 0 would move by 0.7 % from there to frame 1; settled, by the 1 % that is new over its memory of 24.
    first, second = (described.opened(1).depth_m_at(Moment(number, 0.0, (32, 24))) for number in (0, 1))
    assert np.abs(second / first - 1.0).mean() < 0.0015
    with pytest.raises(InputError, match="is 32x24 px but the clip is 64x24 px"):
        described.opened(1).depth_m_at(Moment(3, 0.0, (64, 24)))
