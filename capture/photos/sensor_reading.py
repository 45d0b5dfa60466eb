"""SensorReading: how large the pixels of a sensor are, and what part of it a picture shows."""

from dataclasses import dataclass

from mrbokeh.images.exif import as_it_lies, is_same_shape

# A RAW shows a few pixels more than the JPEG of its camera; a picture that differs by more was resized or cut.
_MARGIN = 0.05


@dataclass(frozen=True)
class SensorReading:
    """Millimetres per pixel in a picture of full_size_px (width, height), if that size is known; source: the tag it came from."""

    pitch_mm: float
    full_size_px: tuple[int, int] | None
    source: str

    def width_mm(self, width_px: int, height_px: int) -> float:
        """Width on the sensor of a picture as it is stored.

        The full size, or nearly (RAW margins): pitch times width. Another size but the same shape: the picture was
        resized and shows the full width. Another shape: it was cut out, at full resolution as far as anyone can tell.
        """
        if self.full_size_px is None:
            return self.pitch_mm * width_px
        full_width, full_height = as_it_lies(self.full_size_px, (width_px, height_px))
        resized = abs(width_px / full_width - 1.0) > _MARGIN
        same_shape = is_same_shape((width_px, height_px), (full_width, full_height))
        return self.pitch_mm * (full_width if resized and same_shape else width_px)
