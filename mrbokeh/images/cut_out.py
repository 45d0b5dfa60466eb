"""Whether a photograph was cut out of what its camera took: then it has another shape than its EXIF tells."""

SizePx = tuple[int, int]
"""Width, height."""

_SAME_ASPECT = 0.01


def as_it_lies(full_px: SizePx, size_px: SizePx) -> SizePx:
    """The size of the whole, with its sides exchanged where the picture was turned by a quarter since."""
    turned = (size_px[0] < size_px[1]) != (full_px[0] < full_px[1])
    return full_px[::-1] if turned else full_px


def is_same_shape(size_px: SizePx, full_px: SizePx) -> bool:
    """To 1 %: sizes are rounded to pixels, and RAW shows a few more than the JPEG of its camera."""
    return abs(size_px[0] / size_px[1] * full_px[1] / full_px[0] - 1.0) < _SAME_ASPECT


def cut_from_px(size_px: SizePx, full_px: SizePx | None) -> SizePx | None:
    """The size of the whole, or None where it is not known or the picture shows all of it.

    What does not fit into the whole as it was taken was turned by a quarter since.
    """
    if full_px is None or min(*full_px, *size_px) < 1:
        return None
    whole_px = as_it_lies(full_px, size_px)
    if is_same_shape(size_px, whole_px):
        return None
    return full_px if size_px[0] <= full_px[0] and size_px[1] <= full_px[1] else whole_px
