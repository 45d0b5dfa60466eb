"""DaskCrew: workers of a Dask cluster, on this machine or others, that see the same files under the same names."""

import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mrbokeh import __version__
from mrbokeh.shots.crew import Progress
from mrbokeh.shots.segment_task import SegmentTask, make_segment
from mrbokeh.system.errors import InputError, MissingExtraError


class DaskCrew:
    """A Crew. address: of the scheduler, tcp://HOST:8786. Each task takes one core, so start workers with one thread each.

    Dask gives the segment of a dead worker to another; one that kills four workers is given up.
    """

    threads = 1

    def __init__(self, address: str, patience_s: float = 10.0) -> None:
        self.address, self._patience_s = address, patience_s

    def run(self, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        if not tasks:
            return
        with self._client() as client:
            require_same_files(client, tasks[0].folder, tasks[0].shot.source.path)
            self._compute(client, tasks, progress)

    def _compute(self, client: Any, tasks: Sequence[SegmentTask], progress: Progress) -> None:
        from distributed import KilledWorker, as_completed

        futures = {client.submit(make_segment, task, pure=False): task for task in tasks}
        try:
            for future in as_completed(list(futures), loop=client.loop):
                future.result()
                progress(futures[future].segment.frame_count)
        except KilledWorker as error:
            raise InputError(f"one segment killed the workers of {self.address} again and again (too little memory?): {error}") from None
        finally:
            client.cancel(list(futures))

    @contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            from distributed import Client
        except ModuleNotFoundError:
            raise MissingExtraError("distributed", "cluster") from None
        try:
            client = Client(self.address, timeout=self._patience_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {self.address} ({error}): start one with `dask scheduler`") from None
        with client:
            yield client


def require_same_files(client: Any, folder: Path, clip: Path) -> None:
    """Every worker must read what is written here, see the clip and run this version. Raises InputError otherwise."""
    token, secret = folder / f"token-{secrets.token_hex(4)}", secrets.token_hex(16)
    token.write_text(secret, encoding="utf-8")
    try:
        reports = client.run(_report, str(token), str(clip))
    finally:
        token.unlink(missing_ok=True)
    if not reports:
        raise InputError("the cluster has no workers: start some with `dask worker ADDRESS --nthreads 1`")
    for worker, (read, sees_clip, version) in reports.items():
        if version != __version__:
            raise InputError(f"worker {worker} runs mrbokeh {version}, but this is {__version__}: install the same version on both")
        if read != secret or not sees_clip:
            lacking = folder if read != secret else clip
            raise InputError(
                f"worker {worker} does not see {lacking}: a cluster needs a file system that all machines share under one name"
            )


def _report(token: str, clip: str) -> tuple[str, bool, str]:
    """On a worker: (what stands in the token, whether the clip is there, version)."""
    from mrbokeh.video.picture_sources.numbered_files import NumberedFiles, is_pattern

    try:
        read = Path(token).read_text(encoding="utf-8")
    except OSError:
        read = ""
    try:
        there = bool(NumberedFiles.found(Path(clip)).files) if is_pattern(clip) else Path(clip).is_file()
    except InputError:
        there = False
    return read, there, __version__
