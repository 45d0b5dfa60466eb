"""What COLMAP is asked to do, as a document: it crosses to the process that runs COLMAP and tells whether old results still fit."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

CAMERA_MODELS = ("SIMPLE_RADIAL", "RADIAL")
FEWEST_FOR_TWO_TERMS = 5
"""Pictures of one camera below which a second term of distortion fits noise: alone, it ran to -200 on sacre_coeur's facade."""

MAPPERS = ("incremental", "global")


@dataclass(frozen=True)
class ColmapPicture:
    """name: of the view. file: relative to the folder of pictures. sha256: of the file. camera: pictures of one number share a camera."""

    name: str
    file: str
    sha256: str
    camera: int


@dataclass(frozen=True)
class ColmapJob:
    """Pictures, cameras and settings.

    fewest_terms: leave out terms of distortion that the pictures do not bear out, once the poses are found.
    cameras: for each camera the prior (focal length, principal point x, y) in px of the pictures, or None to take what the
      files' Exif tells.
    pictures_folder: of the pictures, relative to the folder of the reconstruction or absolute.
    """

    pictures: tuple[ColmapPicture, ...]
    cameras: tuple[tuple[float, float, float] | None, ...]
    pictures_folder: str = "images"
    camera_model: str = "RADIAL"
    fewest_terms: bool = True
    mapper: str = "incremental"
    max_image_size_px: int = 1600
    seed: int = 0
    threads: int = -1

    def file_of(self, name: str) -> str:
        """Of the picture of that view, relative to the folder of pictures."""
        return next(each.file for each in self.pictures if each.name == name)

    def features_key(self) -> dict[str, Any]:
        """What the features and matches depend on: where it differs, the database is of no use."""
        document = job_to_json(self)
        return {key: value for key, value in document.items() if key not in ("mapper", "threads", "fewest_terms")}


def job_to_json(job: ColmapJob) -> dict[str, Any]:
    document = asdict(job)
    return document | {
        "pictures": [asdict(each) for each in job.pictures],
        "cameras": [None if prior is None else list(prior) for prior in job.cameras],
    }


def job_from_json(document: dict[str, Any]) -> ColmapJob:
    pictures = tuple(ColmapPicture(**each) for each in document["pictures"])
    cameras = tuple(None if prior is None else (prior[0], prior[1], prior[2]) for prior in document["cameras"])
    return ColmapJob(**document | {"pictures": pictures, "cameras": cameras})


def camera_model_for(cameras: Sequence[int], choice: str) -> str:
    """auto: two terms of distortion where every camera has pictures enough, else one. cameras: the number of each picture's."""
    if choice != "auto":
        return choice
    fewest = min(Counter(cameras).values())
    return "RADIAL" if fewest >= FEWEST_FOR_TWO_TERMS else "SIMPLE_RADIAL"
