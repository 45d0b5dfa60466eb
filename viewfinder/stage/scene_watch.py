"""SceneWatch: whether the scene file or a file that it names was written since it was read; asks the file system, waits for nothing."""

from collections.abc import Iterable
from pathlib import Path

from mrbokeh.scene.staging.assets import modified_s


class SceneWatch:
    """A file that is being written changes again and again: `changed` says so only once it has kept still between two calls."""

    def __init__(self, files: Iterable[Path]) -> None:
        self._read = self._seen = _state(files)

    def changed(self) -> bool:
        now = _state(self._seen)
        is_still, self._seen = now == self._seen, now
        return is_still and now != self._read

    def follow(self, files: Iterable[Path]) -> None:
        """What `changed` saw has been read, or refused; watch these files from here on."""
        # Of a file that was watched already it is the state before the reading: what was written during it is not missed.
        self._read = self._seen = {path: self._seen.get(path, modified_s(path)) for path in files}


def _state(files: Iterable[Path]) -> dict[Path, float]:
    return {path: modified_s(path) for path in files}
