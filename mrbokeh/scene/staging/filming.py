"""Filming: render settings that turn a staged scene into layers of a plate: backend, distortion, shutter and shadow."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64

from mrbokeh.distortion import LensDistortion, distorted, overscan_camera
from mrbokeh.images.layer import Layer, clear
from mrbokeh.layering.motion import MOTION, with_motion
from mrbokeh.layering.pixel_box import Box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene, SceneRenderer
from mrbokeh.scene.choose import scene_renderer
from mrbokeh.scene.light_change import GREY, LightChange, light_change, light_left
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.moving_layers import FilmedScene, ShutterTiming, moving_layer, moving_shadow_layer
from mrbokeh.scene.moving_layers.moving_layer import ShadowCatcher
from mrbokeh.scene.staging.picture_box import shadow_box
from mrbokeh.scene.staging.scene_description import SceneDescription
from mrbokeh.scene.staging.staged_scene import Assets, StagedScene
from mrbokeh.scene.virtual_scene import shadow_layer
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import upright_camera

CATCHES = ("shadow", "light")
_FEW_PX, _FEW_SAMPLES = 5_000, 16
_MOST_PX, _UNEVEN, _WINDOW_PX, _NOISE_PX = 10_000, 0.1, 5, 3
"""Pixels in which the change of light is looked at as a whole; where it differs by more than this share within a window it is computed
anew in twice as many rows and columns, until the picture has no more of them. Noise of soft shadows is averaged over NOISE_PX."""
_COVERS = 0.99
_UNSEEN = 0.004
"""Share of a surface's light whose loss nobody sees: half a code of 8 bits in bright places. So far the shadow fades out."""

CameraAt = Callable[[float], Camera]


@dataclass(frozen=True)
class Filming:
    """Render settings of a staged scene.

    backend: a name of `mrbokeh.scene.choose`. samples: paths per pixel of "mitsuba". distortion: of the plate's lens. catches:
    "shadow", as dark as the scene says, or "light": all that the objects change on the ground (`mrbokeh.scene.light_change`), of which
    caught_share (0 to 1) is shown, computed in at most change_px pixels, and with finer_change in more where it is uneven.
    caught_contrast: power of the light that remains there by which a camera shows it. shutter: motion blur; None for none.
    """

    backend: str = "auto"
    samples: int = 64
    denoise: bool = False
    catches: str = "shadow"
    caught_share: float = 1.0
    caught_contrast: float = 1.0
    distortion: LensDistortion = field(default_factory=LensDistortion)
    shutter: ShutterTiming | None = None
    change_px: int = _MOST_PX
    finer_change: bool = True

    def __post_init__(self) -> None:
        if self.catches not in CATCHES:
            raise InputError(f"expected what the ground catches to be {' or '.join(CATCHES)}, got {self.catches!r}")
        if self.catches == "light" and self.shutter is not None:
            raise InputError("light on the ground is caught of what stands still: leave the shutter out, or catch the shadow alone")

    def renderer(self, threads: int = 0) -> SceneRenderer:
        if self.backend == "mitsuba":
            from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer

            return MitsubaTracer(self.samples, threads=threads, denoise=self.denoise)
        return scene_renderer(self.backend, threads)


def _at_most(camera: Camera, pixels: int) -> Camera:
    """Return the same view in at most so many pixels."""
    scale = min(1.0, (pixels / (camera.width_px * camera.height_px)) ** 0.5)
    return camera.resized(max(1, round(scale * camera.width_px)), max(1, round(scale * camera.height_px)))


def _finer(
    change: LightChange,
    scene: Scene,
    camera: Camera,
    catcher: Mesh,
    covered: Bool[np.ndarray, "height width"],
    size_px: Int64[np.ndarray, "2"],
    samples: int,
) -> LightChange:
    """Return the change in more pixels, computed anew where it is uneven and seen. size_px: rows and columns."""
    height_px, width_px = size_px.tolist()
    change = change.enlarged(height_px, width_px)
    window = np.ones((_WINDOW_PX, _WINDOW_PX))
    uneven = (cv2.dilate(change.ratio, window) - cv2.erode(change.ratio, window)).max(axis=2) > _UNEVEN
    hidden = cv2.resize(covered.astype(np.uint8), (width_px, height_px), interpolation=cv2.INTER_NEAREST) > 0
    pixels, ratio = np.flatnonzero(uneven & ~hidden), change.ratio.reshape(-1, 3).copy()
    if scene.lighting[0]:
        twice, (rows, columns) = camera.resized(2 * width_px, 2 * height_px), 2 * np.array(np.divmod(pixels, width_px))
        places = [(rows + down) * twice.width_px + columns + right for down in (0, 1) for right in (0, 1)]
        ratio[pixels] = np.mean([light_left(scene, twice, catcher, each, samples // 4 + 1) for each in places], axis=0)
    else:
        ratio[pixels] = light_left(scene, camera.resized(width_px, height_px), catcher, pixels, samples)
    return replace(change, ratio=ratio.reshape(change.ratio.shape))


def _without_noise(
    ratio: Float32[np.ndarray, "height width 3"], covered: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width 3"]:
    """Return the mean of what is not covered in the window of each pixel: soft shadows are smooth, what was drawn of them is rough."""
    seen = (~covered).astype(np.float32)
    share = cv2.blur(seen, (_NOISE_PX, _NOISE_PX))[..., None]
    mean = cv2.blur(ratio * seen[..., None], (_NOISE_PX, _NOISE_PX)) / np.maximum(share, 1e-6)
    return np.where(share > 1e-3, mean, ratio).astype(np.float32)


def _beside(
    covered: Bool[np.ndarray, "height width"], ratio: Float32[np.ndarray, "height width 3"]
) -> Float32[np.ndarray, "height width 3"]:
    """Return the picture with what is covered replaced by the nearest that is not."""
    if covered.all() or not covered.any():
        return ratio
    _, nearest = cv2.distanceTransformWithLabels(covered.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    seen = ~covered
    values = np.zeros((int(nearest.max()) + 1, 3), np.float32)
    values[nearest[seen]] = ratio[seen]
    return values[nearest]


class FilmedLayers:
    """A scene before a plate's camera. Backends keep what they prepared, so one of these serves all frames."""

    def __init__(
        self,
        filming: Filming,
        description: SceneDescription,
        threads: int = 0,
        assets: Assets | None = None,
        renderer: SceneRenderer | None = None,
    ) -> None:
        """Open the scene. assets, renderer: of an earlier picture, whose files and prepared scenes are used again."""
        self._filming, self._renderer = filming, renderer or filming.renderer(threads)
        self._staged = StagedScene.load(description, assets or Assets(), moment_s=0.0)

    @property
    def changes_by_itself(self) -> bool:
        """Whether layers can differ between two moments that show the same camera: by animation, or by the shutter."""
        return self._staged.is_animated or self._filming.shutter is not None

    def at(self, camera_at: CameraAt, time_s: float = 0.0, sharp_rgb: Float32[np.ndarray, "height width 3"] | None = None) -> list[Layer]:
        """Sharp layers of the plate's size, front first: the objects, and behind them what they change on the ground.

        camera_at: the plate's camera by the time, with its pose in the world of the scene file; time_s: of the scene.
        sharp_rgb: the plate, all in focus where that is known, for what the ground loses colour by colour; without it, and with
        distortion, all colours lose alike.
        """
        plate, wide_at = camera_at(time_s), self._wide(camera_at)
        wide = wide_at(time_s)
        if self._filming.shutter is None:
            scene = self._staged.scene_at(time_s)
            objects = self._objects(scene, wide)
            layers = [objects, *self._caught(scene, wide, objects, sharp_rgb if self._filming.distortion.is_none else None)]
        else:
            shutter = self._filming.shutter.within(wide, plate)
            layers = self._moving(FilmedScene(self._staged.scene_at, wide_at, shutter), time_s)
        return [distorted(layer, wide, plate, self._filming.distortion) for layer in layers]

    def _wide(self, camera_at: CameraAt) -> CameraAt:
        """The pinhole that sees all that the plate sees, in the upright world."""
        up, distortion = self._staged.description.up, self._filming.distortion
        return lambda time_s: overscan_camera(upright_camera(camera_at(time_s), up), distortion)

    def _moving(self, filmed: FilmedScene, time_s: float) -> list[Layer]:
        layers = [moving_layer(self._renderer, filmed, time_s)]
        shadow, catcher = self._staged.description.shadow, self._staged.catcher
        if shadow is not None and catcher is not None:
            layers.append(moving_shadow_layer(self._renderer, filmed, time_s, ShadowCatcher(catcher, shadow.strength)))
        if all(MOTION not in layer.extra for layer in layers):
            return layers
        still_px = np.zeros((*layers[0].alpha.shape, 2), np.float32)  # of what was averaged over the shutter, or is out of sight
        return [layer if MOTION in layer.extra else with_motion(layer, still_px) for layer in layers]

    def _objects(self, scene: Scene, camera: Camera) -> Layer:
        """The objects alone; with light on the ground they also see the ground, where the backend follows light so far."""
        catcher = self._staged.catcher
        if self._filming.backend == "mitsuba" and self._filming.catches == "light" and catcher is not None:
            return self._renderer.render_beside(scene, camera, [replace(catcher, material=GREY, catches_shadow=False)])  # type: ignore[attr-defined]
        return self._renderer.render(scene, camera)

    def _caught(self, scene: Scene, camera: Camera, objects: Layer, sharp_rgb: Float32[np.ndarray, "height width 3"] | None) -> list[Layer]:
        shadow, catcher = self._staged.description.shadow, self._staged.catcher
        if shadow is None or catcher is None:
            return []
        if self._filming.catches == "shadow":
            return [self._shadow(scene, camera, ShadowCatcher(catcher, shadow.strength))]
        frame = Box(0, camera.height_px, 0, camera.width_px)
        box = frame if self._filming.backend == "mitsuba" else self._changed_box(scene, camera, catcher, objects.alpha)
        if box.is_empty:
            return [clear(camera.height_px, camera.width_px)]
        alpha = np.ascontiguousarray(box.of(objects.alpha))
        change = self._change(scene, box.camera_of(camera), catcher, alpha)
        change = change.deepened(self._filming.caught_contrast).weakened(self._filming.caught_share)
        part_rgb = None if sharp_rgb is None else np.ascontiguousarray(box.of(sharp_rgb))
        part = change.evenly().as_layer(np.zeros_like(change.ratio)) if part_rgb is None else change.as_layer(part_rgb)
        return [part if box == frame else box.placed(part, frame.size_px)]

    def _changed_box(self, scene: Scene, camera: Camera, catcher: Mesh, alpha: Float32[np.ndarray, "height width"]) -> Box:
        """Return the part of the frame in which one sees objects of that alpha or the light change, which is looked at in few pixels."""
        frame = Box(0, camera.height_px, 0, camera.width_px)
        few = _at_most(camera, _FEW_PX)
        ratio = light_change(self._renderer, scene, few, catcher, samples=_FEW_SAMPLES).ratio
        shown = cv2.resize(alpha, (few.width_px, few.height_px), interpolation=cv2.INTER_AREA) > 0.0
        rows, columns = np.nonzero((ratio.min(axis=2) < 1.0 - _UNSEEN) | shown)
        if not len(rows):
            return Box(0, 0, 0, 0)
        step = camera.width_px / few.width_px
        low, high = (np.array([rows, columns]).min(axis=1) - 1) * step, (np.array([rows, columns]).max(axis=1) + 2) * step
        (top, left), (bottom, right) = low.astype(int).tolist(), np.ceil(high).astype(int).tolist()
        return Box(top, bottom, left, right).within(frame.size_px)

    def _change(self, scene: Scene, camera: Camera, catcher: Mesh, alpha: Float32[np.ndarray, "height width"]) -> LightChange:
        """Return the change of light that one sees beside objects of that alpha, computed in few pixels and in more where it is uneven.

        The ground under an object is dark, but nobody sees it: pixels that the object covers, and those on its rim, have what is seen
        next to them. Where lights throw sharp shadows, each pixel is looked at in four places.
        """
        samples = self._filming.samples // 2 + 1
        if self._filming.backend == "mitsuba":
            return light_change(self._renderer, scene, camera, catcher, samples=self._filming.samples)
        change = light_change(self._renderer, scene, _at_most(camera, self._filming.change_px), catcher, samples=samples)
        covered = (cv2.dilate(alpha, np.ones((3, 3))) > _COVERS) & (alpha > 0.0)
        size_px = np.array([camera.height_px, camera.width_px])
        while self._filming.finer_change and change.alpha.shape != tuple(size_px):
            change = _finer(change, scene, camera, catcher, covered, np.minimum(2 * np.array(change.alpha.shape), size_px), samples)
        change = change.enlarged(camera.height_px, camera.width_px)
        if not scene.lighting[0]:
            change = replace(change, ratio=_without_noise(change.ratio, covered))
        return replace(change, ratio=np.minimum(_beside(covered, change.ratio) + np.float32(_UNSEEN), np.float32(1.0)))

    def _shadow(self, scene: Scene, camera: Camera, catcher: ShadowCatcher) -> Layer:
        """Drawn where hard shadows fall; the path tracer's are soft and may fall anywhere."""
        frame = Box(0, camera.height_px, 0, camera.width_px)
        box = frame if self._filming.backend == "mitsuba" else shadow_box(scene, camera, catcher.mesh)
        if box.is_empty:
            return clear(camera.height_px, camera.width_px)
        part = shadow_layer(self._renderer, scene, box.camera_of(camera), catcher.mesh, catcher.strength)
        return part if box == frame else box.placed(part, frame.size_px)
