"""How long previews of `mrbokeh studio` take, warm: `python -m tests.bench.bench_studio [PHOTO ...]`, else of made ones of 1 and 12 MP."""

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.support.made_studio import CAKE, write_floor
from viewfinder.studio.command_line import options_of
from viewfinder.studio.photograph import open_photograph, placed
from viewfinder.studio.preview import Previewer, Wish
from viewfinder.studio.state import StudioState

_SCREEN_PX = 1e6
_DRAGS, _RESTS = 30, 5


def measure(photo: Path) -> str:
    """Return a line of times in ms: drafts while the object is dragged, and refined pictures, with and without a main light."""
    opened, _rgb = open_photograph(photo)
    width_px, height_px = opened.size_px
    first = placed(StudioState(photo=photo, object=CAKE, at_px=(0.5 * width_px, 0.8 * height_px), pitch_deg=5.0), opened)
    previewer, told = Previewer(), []
    for sun_deg in (None, (-60.0, 40.0)):
        for draft, count in ((True, _DRAGS), (False, _RESTS)):
            took_ms, sizes_px = list[float](), set[tuple[int, int]]()
            for step in range(count + 3):
                state = replace(first, at_px=((0.4 + 0.2 * step / count) * width_px, 0.8 * height_px), sun_deg=sun_deg)
                began_s = time.perf_counter()
                made = previewer.ask("bench", Wish(opened, options_of(state), _SCREEN_PX, draft=draft)).result()
                assert made is not None
                took_ms += [1e3 * (time.perf_counter() - began_s)] if step > 2 else []
                sizes_px.add(tuple(made[0]["size_px"]))
            median, worst = np.median(took_ms), np.percentile(took_ms, 90)
            size = " or ".join(f"{width}x{height}" for width, height in sorted(sizes_px))
            told.append(f"{'draft' if draft else 'refined'}{' with sun' if sun_deg else ''} {median:.0f} (90 %: {worst:.0f}; {size} px)")
    previewer.close()
    return f"{photo.name}, {width_px}x{height_px} px: " + ", ".join(told)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        made = [(1152, 864), (4000, 3000)]
        photographs = [Path(each) for each in sys.argv[1:]] or [write_floor(Path(folder) / f"{w}x{h}.png", w, h) for w, h in made]
        for photo in photographs:
            print(measure(photo))
