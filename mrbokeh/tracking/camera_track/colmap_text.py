"""cameras.txt and images.txt of a COLMAP model."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.colmap_camera import MODELS, ColmapCamera, ColmapImage, model_number


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """CAMERA_ID MODEL WIDTH HEIGHT PARAMS."""
    cameras = {}
    for line, where in _lines(path):
        if not line:
            continue
        parts = line.split()
        try:
            number, width_px, height_px = int(parts[0]), int(parts[2]), int(parts[3])
            parameters = tuple(float(each) for each in parts[4:])
        except (IndexError, ValueError):
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line!r}") from None
        cameras[number] = ColmapCamera(model_number(parts[1], where), width_px, height_px, parameters)
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    """IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each with a line of its points, which may be empty."""
    images = []
    for index, (line, where) in enumerate(_lines(path)):
        if index % 2:
            continue
        parts = line.split(maxsplit=9)
        try:
            values = [float(each) for each in parts[1:8]]
            images.append(ColmapImage(parts[9], tuple(values[:4]), tuple(values[4:]), int(parts[8])))
        except (IndexError, ValueError):
            if not line:
                continue
            raise InputError(f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:80]!r}") from None
    return images


def write(folder: Path, cameras: Mapping[int, ColmapCamera], images: Sequence[ColmapImage]) -> None:
    """Also an empty points3D.txt, without which COLMAP opens no model."""
    camera_lines = [
        " ".join([str(number), MODELS[each.model][0], str(each.width_px), str(each.height_px), *map(repr, each.parameters)])
        for number, each in cameras.items()
    ]
    image_lines = [
        " ".join([str(number), *map(repr, (*each.turn, *each.shift)), str(each.camera), each.name]) + "\n"
        for number, each in enumerate(images, 1)
    ]
    for name, lines in (("points3D.txt", []), ("cameras.txt", camera_lines), ("images.txt", image_lines)):
        with atomic_path(folder / name) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """(text, where it is) of all lines but comments, with the empty ones: those may be an image without points."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"expected text in {path}, but it is not") from None
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield line.strip(), f"{path}, line {number}"
