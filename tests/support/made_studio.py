"""A small photograph of a floor with a wall behind it, and a studio that serves it on loopback."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrbokeh.images.image_io import write_image
from mrbokeh.system.errors import InputError
from viewfinder.server.access import Access
from viewfinder.server.endpoint import serving_site
from viewfinder.studio import photograph
from viewfinder.studio.desk import Desk
from viewfinder.studio.project import Project
from viewfinder.studio.running import SHIPPED
from viewfinder.studio.site import StudioSite
from viewfinder.studio.state import StudioState

WIDTH, HEIGHT = 240, 180
CAKE, ALIEN = SHIPPED / "cakeBirthday.glb", SHIPPED / "alien.glb"


_floors: dict[tuple[str, int, int], bytes] = {}


def write_floor(path: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """Write a chequered floor below a level horizon, and an even wall above it; large ones take a second, and are made once."""
    key = (path.suffix, width, height)
    if key in _floors:
        path.write_bytes(_floors[key])
        return path
    rows, columns = np.arange(height)[:, None] + 0.5, np.arange(width) + 0.5
    down = np.maximum(rows - height / 2, 0.5) / width
    across, ahead = (columns - width / 2) / width / down, 1.0 / down
    tiles = (np.floor(across) + np.floor(ahead / 2)) % 2
    light = np.where(rows > height / 2, 0.25 + 0.35 * tiles, 0.5)
    rgb = (light[..., None] * [1.0, 0.95, 0.85]).astype(np.float32)
    write_image(path, rgb)
    _floors[key] = path.read_bytes()
    return path


_solved, _answers = photograph.solved, dict[bytes, Any]()


def solved_once(told: Any, lines: Any = ()) -> Any:
    """The camera of a photograph, or the refusal, looked for once for each picture: half a second, and most tests take the same floor."""
    key = told.rgb.tobytes() + repr(lines).encode()
    if key not in _answers:
        try:
            _answers[key] = _solved(told, lines)
        except InputError as error:
            _answers[key] = error
    if isinstance(_answers[key], InputError):
        raise _answers[key]
    return _answers[key]


def unsolved(_told: Any, _lines: Any = ()) -> Any:
    """In place of `photograph.solved` where a large picture's tilt is given: to look for its camera takes a second."""
    raise InputError("nobody looks for lines in this test")


@dataclass
class MadeStudio:
    url: str
    desk: Desk
    folder: Path


@asynccontextmanager
async def made_studio(folder: Path, state: StudioState | None = None, access: Access | None = None) -> AsyncIterator[MadeStudio]:
    """Serve a studio whose page offers the two shipped objects. state: the first one; None begins without a photograph."""
    project = Project(folder / "kept.studio.json", [state or StudioState()], objects=[CAKE, ALIEN])
    desk = Desk(project, folder)
    with pytest.MonkeyPatch.context() as patch:
        if photograph.solved is _solved:
            patch.setattr(photograph, "solved", solved_once)
        async with serving_site(StudioSite(desk, access or Access()), "127.0.0.1", 0) as url:
            yield MadeStudio(url, desk, folder)
