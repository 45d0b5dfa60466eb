"""Frame numbers from the names of pictures."""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath


def frame_numbers(names: Sequence[str]) -> list[int]:
    """The last number in each name (frame_00012.png is 12); where one has none, or two have the same, places in the order of names."""
    found = [re.findall(r"\d+", PurePosixPath(name.replace("\\", "/")).stem) for name in names]
    numbers = [int(each[-1]) for each in found if each]
    if len(numbers) == len(set(numbers)) == len(names):
        return numbers
    place = {name: index for index, name in enumerate(sorted(names))}
    return [place[name] for name in names]


def picture_name(number: int) -> str:
    """What `frame_numbers` reads back; no name tells a negative number."""
    return f"frame_{number:06d}.png"
