"""The lens and the camera of a stack, as far as metadata and lens.toml tell; and in words what is missing."""

from collections.abc import Sequence

from capture.stacks.grouping import Photo
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json
from mrbokeh.system.errors import InputError


def lens_of_photo(photo: Photo, native_size_px: tuple[int, int]) -> tuple[Lens | None, str | None]:
    """The lens as it was focused for a photograph of native_size_px (width, height) before any reduction; or None and why."""
    focus_m, optics = photo.focus_distance_m, optics_of_photo(photo, native_size_px)
    missing = [name for name, value in (optics | {"focus_distances_m": focus_m}).items() if value is None]
    focal_length_mm, f_number, sensor_width_mm = optics.values()
    if focal_length_mm is None or f_number is None or sensor_width_mm is None or focus_m is None:
        return None, f"{photo.path.name} does not tell {', '.join(missing)}{_why_no_focus(photo)}"
    try:
        return Lens(focal_length_mm, f_number, focus_m, sensor_width_mm, photo.sidecar.aperture), None
    except InputError as error:
        return None, f"{photo.path.name}: {error}"


def optics_of_photo(photo: Photo, native_size_px: tuple[int, int]) -> dict[str, float | None]:
    """focal_length_mm, f_number and sensor_width_mm, as far as they are known."""
    metadata, sensor_width_mm = photo.metadata, photo.sidecar.sensor_width_mm
    if sensor_width_mm is None and metadata.sensor is not None:
        sensor_width_mm = metadata.sensor.width_mm(*native_size_px)
    return {"focal_length_mm": metadata.focal_length_mm, "f_number": metadata.f_number, "sensor_width_mm": sensor_width_mm}


def _why_no_focus(photo: Photo) -> str:
    """A stated distance that could not be used needs a word of explanation."""
    focus, focal_length_mm = photo.metadata.focus, photo.metadata.focal_length_mm
    if focus is None or photo.focus_distance_m is not None:
        return ""
    if focal_length_mm is None:
        return f" ({focus.source} counts from the film plane; the lens's distance follows once the focal length is known)"
    return f" ({focus.source} from the film plane is nearer than a thin lens of {focal_length_mm:g} mm can focus)"


def camera_of_lens(lens: Lens, width_px: int, height_px: int) -> Camera:
    """Square pixels, the principal point in the middle of the picture."""
    focal_px = lens.focal_px(width_px)
    return Camera(width_px, height_px, (focal_px, focal_px), (width_px / 2.0, height_px / 2.0))


def reference_index(focus_distances_m: Sequence[float | None]) -> int:
    """The slice with the narrowest field: the one focused nearest, so far as distances are known, else the first."""
    known = [(distance, index) for index, distance in enumerate(focus_distances_m) if distance is not None]
    return min(known)[1] if known else 0


def lens_remarks(photos: Sequence[Photo]) -> list[str]:
    """What speaks against one lens for all slices: differing focal lengths or f-numbers, partly unknown distances."""
    remarks = []
    for name, unit in (("focal_length_mm", " mm"), ("f_number", "")):
        values = sorted({round(value, 3) for photo in photos if (value := getattr(photo.metadata, name)) is not None})
        if len(values) > 1:
            listed = ", ".join(f"{value:g}{unit}" for value in values)
            remarks.append(f"{name} differs within the stack ({listed}): the reference's is used")
    unknown = [photo.path.name for photo in photos if photo.focus_distance_m is None]
    if unknown:
        remarks.append(
            f"no focus distance for {len(unknown)} of {len(photos)} slices ({', '.join(unknown[:4])}{' ...' if len(unknown) > 4 else ''}): "
            f"merging finds their blur in pixels and their order from the pictures, and guesses metres"
        )
    return remarks + sentinel_remarks(photos)


def sentinel_remarks(photos: Sequence[Photo]) -> list[str]:
    """Say that a camera's word for infinity is no distance, and how to give one."""
    told = [(photo.path.name, focus.source) for photo in photos if (focus := photo.metadata.focus) is not None and focus.is_sentinel]
    if not told:
        return []
    names = f"{', '.join(name for name, _ in told[:4])}{' ...' if len(told) > 4 else ''}"
    states, taken = ("states its focus", "its distance is") if len(told) == 1 else ("state their focus", "their distances are")
    return [
        f"{names} {states} by a sentinel ({told[0][1]}), which cameras write for all that is far: {taken} not known, taken as infinity "
        f"where nothing else tells, and left out where stated distances are weighed; a focus.csv overrides it"
    ]


def lens_text(lens: Lens | None) -> str:
    """A lens in a few words, for tables."""
    if lens is None:
        return "unknown"
    sides = [len(outline) for outline in lens_to_json(lens)["aperture"]["outlines"]]
    blades = f", {sides[0]} blades" if len(sides) == 1 and sides[0] < 32 else ""
    blades += ", central obstruction" if min(lens.aperture.weights) < 0 else ""
    return f"{lens.focal_length_mm:.4g} mm f/{lens.f_number:.3g}{blades}, sensor {lens.sensor_width_mm:.4g} mm"
