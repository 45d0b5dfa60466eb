"""MitsubaTracer: virtual scenes to Layers by path tracing, compiled by Mitsuba 3 (Jakob et al. 2022) with its LLVM variant.

Noise can be removed by Intel's Open Image Denoise (Afra 2019), which the package `pyoidn` brings for processors. Denoising pays with
few paths. Against 4096 paths it gained 4.0 to 5.6 dB with 4 paths per pixel, 0.2 to 2.8 dB with 16; with 64 it gained 1.4 dB on smooth
balls under a small light and lost 3.2 dB on a finely textured helmet (pictures of 160x90 and 213x120). So it is off by default.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.virtual_scene import Scene
from mrbokeh.system.errors import InputError, MissingExtraError

LLVM = "llvm_ad_rgb"

_PLACES = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")
_PATTERNS = ("libLLVM*", "*/libLLVM*", "llvm-*/lib/libLLVM*")
_TESTED = 19
# Debian's LLVM 14 and 15, which Mesa brings, abort the process on processors with AVX-512.
_FIRST_USABLE = 16


@dataclass(frozen=True, eq=False)
class Guides:
    """Means over the paths of some pixels that met a surface. share: how many did.

    albedo, normal (in the world, shorter than 1 if several are mixed): of the first surface.
    """

    color: Float32[np.ndarray, "pixels 3"]
    share: Float32[np.ndarray, " pixels"]
    albedo: Float32[np.ndarray, "pixels 3"]
    normal: Float32[np.ndarray, "pixels 3"]


class MitsubaTracer:
    """SceneRenderer for pictures that may take their time: light that objects pass on to each other, soft shadows of the environment,
    emissive surfaces that light their surroundings. Needs `mitsuba` and an LLVM library.

    Coverage and depth are the ray caster's, which are exact and free of noise; paths give the colour of what is covered. The reflection
    is the ray caster's too (glTF 2.0, appendix B), so under lights without extent alone and with most_bounces = 1 both backends show
    the same but for rough metals, whose lost light is given back here. Occlusion textures are not read: here light itself is occluded.
    Emissive surfaces are area lights; unlit ones show their base colour, also in reflections. Use it from one thread.
    """

    def __init__(
        self,
        samples: int = 64,
        most_bounces: int = 6,
        seed: int = 0,
        threads: int = 0,
        denoise: bool = False,
    ) -> None:
        """Set up the tracer and Mitsuba's compiler.

        samples: paths per pixel, rounded up to a number that divides into a grid. most_bounces: surfaces that light meets on its way to
        the camera; 1 is direct light only. threads: 0 leaves the compiler's number, all cores at first. denoise: pays with few samples;
        needs `pyoidn`.

        Raises MissingExtraError if Mitsuba or the denoiser is not installed and InputError if its compiler is missing.
        """
        if samples < 1 or most_bounces < 0 or threads < 0:
            raise InputError(
                f"expected at least one sample and no negative bounces or threads, got {samples}, {most_bounces} and {threads}"
            )
        load(threads)
        if denoise:
            require_denoiser()
        self.samples, self.most_bounces, self.seed = samples, most_bounces, seed
        self._threads, self._denoise = threads, denoise
        self.caster = EmbreeRaycaster(threads)
        self._kept: tuple[Scene, tuple[Mesh, ...], Any] | None = None

    def prepare(self) -> None:
        """Choose Mitsuba's variant, which is one for the whole process, and the number of threads."""
        load(self._threads)

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur; see SceneRenderer."""
        return self.render_beside(scene, camera, ())

    def render_beside(self, scene: Scene, camera: Camera, surroundings: Sequence[Mesh]) -> Layer:
        """The scene beside real surfaces, which are not drawn but hide light from it and pass light on to it."""
        shapes = self.caster.render(scene, camera)
        pixels = np.flatnonzero(shapes.alpha > 0)
        if not len(pixels):
            return shapes
        guides = self._traced(scene, camera, surroundings, pixels)
        color = denoised(guides, pixels, (camera.height_px, camera.width_px)) if self._denoise else guides.color
        rgb = shapes.rgb.reshape(-1, 3).copy()
        # Where no path met what the ray caster's own samples did, its colour stays.
        met = guides.share > 0
        rgb[pixels[met]] = color[met] * shapes.alpha.reshape(-1)[pixels[met], None]
        return Layer(rgb.reshape(shapes.rgb.shape), shapes.alpha, shapes.depth_m)

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """Return the (H, W) share of the lights' irradiance that reaches the catcher past the scene, by the ray caster; see
        SceneRenderer.
        """
        return self.caster.render_shadow_mask(scene, camera, catcher)

    def _traced(self, scene: Scene, camera: Camera, surroundings: Sequence[Mesh], pixels: Int64[np.ndarray, " pixels"]) -> Guides:
        """Trace paths through some pixels."""
        self.prepare()
        import mitsuba as mi

        from mrbokeh.scene.mitsuba.paths import CameraRays, Rays, followed

        world = self._world(scene, tuple(surroundings))
        lens, parts = CameraRays(camera, world.centre_m, self.samples), []
        for origin, direction, width, sampler in lens.parts(pixels, self.seed, "tracing paths"):
            rays = Rays(origin, direction, mi.Bool(True), from_camera=True, width_per_m=width)
            parts.append(lens.means(followed(world, rays, sampler, self.most_bounces)))
        share, radiance, albedo, normal = (np.concatenate(column) for column in zip(*parts, strict=True))
        met = np.maximum(share, 1e-6)[:, None]
        return Guides(color=radiance / met, share=share, albedo=albedo / met, normal=normal / met)

    def _world(self, scene: Scene, surroundings: tuple[Mesh, ...]) -> Any:
        """The scene on the device; the last one is kept, so that a film of one scene under many cameras is cheap."""
        from mrbokeh.scene.mitsuba.world import world_of

        last = self._kept
        if last is not None and last[0] is scene and last[1] == surroundings:
            return last[2]
        world = world_of(scene, surroundings, None if last is None else last[2])
        self._kept = scene, surroundings, world
        return world


def load(threads: int = 0) -> Any:
    """Mitsuba with its LLVM variant chosen; threads: 0 leaves the number as it is, which is all cores at first.

    Raises MissingExtraError where Mitsuba is not installed, InputError where there is no LLVM for it.
    """
    library = find_llvm()
    if library is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(library))
    elif _libraries():
        raise _no_llvm(f"there is only {_libraries()[0].name}, and those before {_FIRST_USABLE} abort")
    try:
        import drjit
        import mitsuba
    except ImportError:
        raise MissingExtraError("mitsuba", "mitsuba") from None
    try:
        mitsuba.set_variant(LLVM)
        drjit.eval(mitsuba.Float([0.0]) + 1.0)
    except (ImportError, RuntimeError) as error:
        raise _no_llvm(f"it does not load ({str(error).splitlines()[0]})") from None
    if threads:
        drjit.set_thread_count(threads)
    return mitsuba


def find_llvm() -> Path | None:
    """Return LLVM's shared library: where DRJIT_LIBLLVM_PATH says, else version 19 or, without it, the newest that can be used."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        return Path(named)
    usable = [path for path in _libraries() if _version(path) >= _FIRST_USABLE]
    return max(usable, key=lambda path: (_version(path) == _TESTED, _version(path)), default=None)


def _libraries() -> list[Path]:
    found = [path for place in _PLACES for pattern in _PATTERNS for path in sorted(Path(place).glob(pattern))]
    return [path for path in found if path.is_file() and (".so" in path.name or path.suffix == ".dylib")]


def _version(path: Path) -> int:
    """Return the version that a library's name tells; one that tells none is taken for a usable one."""
    told = re.search(r"LLVM(?:-|\.so\.)(\d+)", path.resolve().name)
    return int(told[1]) if told else _FIRST_USABLE


def _no_llvm(why: str) -> InputError:
    return InputError(
        f"expected the LLVM library that Mitsuba's path tracer compiles with, but {why}: "
        "install one (Debian: apt install libllvm19) or name it in DRJIT_LIBLLVM_PATH, or choose the renderer embree"
    )


def require_denoiser() -> None:
    """Raise MissingExtraError if pyoidn is not installed."""
    try:
        import pyoidn  # noqa: F401
    except ImportError:
        raise MissingExtraError("pyoidn", "denoise") from None


def denoised(guides: Guides, pixels: Int64[np.ndarray, " pixels"], size: tuple[int, int]) -> Float32[np.ndarray, "pixels 3"]:
    """The colour of pixels (row after row of a picture of height and width) without its noise."""
    import pyoidn

    def picture(values: Float32[np.ndarray, "pixels 3"]) -> Float32[np.ndarray, "height width 3"]:
        whole = np.zeros((size[0] * size[1], 3), np.float32)
        whole[pixels] = values
        return whole.reshape(*size, 3)

    albedo = np.clip(picture(guides.albedo), 0.0, 1.0)
    clean = pyoidn.denoise(picture(guides.color), albedo=albedo, normal=picture(guides.normal), hdr=True, clean_aux=True)
    return np.asarray(clean, np.float32).reshape(-1, 3)[pixels]
