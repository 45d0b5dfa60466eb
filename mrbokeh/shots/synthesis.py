"""Focal stacks computed from pictures with depth, many at once: data for depth from focus, deblurring and networks of lenses.

A sample is a picture with its depth, blurred at several focus distances. Samples go into parts, each made by one worker and renamed when
it is whole: a folder (a FocalStack), a shard of a WebDataset (.tar), or a file of HDF5. A part depends on its own pictures and on the
settings only, so that the same bytes come from any number of workers, and a run that was stopped goes on.
"""

import hashlib
import io
import json
import re
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from mrbokeh.depth.depth_map import DepthSettings
from mrbokeh.images.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import ENCODED_SUFFIXES
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json
from mrbokeh.refocus import SharpPhotograph, open_sharp, write_made_stack
from mrbokeh.renderers.choose import lens_and_renderer
from mrbokeh.stacks.focal_stack import FILE_NAME, find_focal_stacks
from mrbokeh.stacks.focus_places import FocusLookup, parse_focus
from mrbokeh.system.atomic_files import atomic_folder, atomic_path, read_json, write_json
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError, MissingExtraError

RECORD = "synthesis.json"
FORMATS = ("folders", "webdataset", "hdf5")
MADE = "synthesized_from"
_PICTURES, _DEPTHS = ("rgb", "image", "images", "color", "aif", "all_in_focus"), ("depth", "depths", "disparity", "disparities", "disp")
_OF_PICTURE, _OF_DEPTH = ("rgb", "image", "color", "aif", "left"), ("depth", "disparity", "disp", "z")
_SUFFIXES = (*ENCODED_SUFFIXES, ".exr", ".npz", ".npy")
_NEAREST_SHARE, _FARTHEST_SHARE = 98.0, 2.0


@dataclass(frozen=True)
class Source:
    """A picture and its depth, None where the picture itself holds it. name: of the sample."""

    name: str
    photo: Path
    depth: Path | None


@dataclass(frozen=True)
class Synthesis:
    """Settings of a set.

    lens: any, None is `Lens.default`; facts: by name, in place of the lens's own. renderer: None is what the lens calls for. depth: what
    the numbers of depth files mean. focus: distances as they are typed; None spreads `slices` of them over the depth of each picture,
    evenly in dioptres. shard: samples in a shard of a WebDataset.
    """

    lens: Path | None = None
    facts: tuple[tuple[str, float], ...] = ()
    renderer: str | None = None
    depth: DepthSettings = field(default_factory=DepthSettings)
    focus: str | None = None
    slices: int = 10
    format: str = "folders"
    shard: int = 32


def sources_in(folder: Path) -> tuple[list[Source], list[str]]:
    """Return (pictures with their depth, names of files without a partner).

    They are merged focal stacks; or pairs of files with equal names in rgb/ and depth/ (or such words); or, in one folder, NAME.png with
    NAME_depth.exr. Raises InputError without one, and where two would have one name.
    """
    if not folder.is_dir():
        raise InputError(f"expected a folder of pictures with depth at {folder}, but there is none")
    found, alone = _stacks_in(folder) if any(folder.rglob(FILE_NAME)) else _pairs_in(folder)
    if not found:
        raise InputError(
            f"{folder} holds no picture with depth: expected rgb/NAME.png with depth/NAME.exr, NAME.png with NAME_depth.exr beside it, or "
            f"merged focal stacks"
        )
    names = [each.name for each in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{folder}: more than one picture would be called {twice[0]} (dots count as _): rename one")
    return sorted(found, key=lambda each: each.name), alone


def _stacks_in(folder: Path) -> tuple[list[Source], list[str]]:
    stacks = find_focal_stacks(folder)
    merged = [stack.folder for stack in stacks if stack.merged]
    names = ["_".join(each.relative_to(folder).parts) or each.name for each in merged]
    found = [Source(_named(name), each, None) for name, each in zip(names, merged, strict=True)]
    return found, [stack.folder.name for stack in stacks if not stack.merged]


def _pairs_in(folder: Path) -> tuple[list[Source], list[str]]:
    below = {each.name.lower(): each for each in folder.iterdir() if each.is_dir()}
    pictures, depths = (next((below[word] for word in words if word in below), None) for words in (_PICTURES, _DEPTHS))
    if pictures is not None and depths is not None:
        shown, known = ([(path.stem, path) for path in _files(each)] for each in (pictures, depths))
    else:
        shown, known = _split(_files(folder))
    of_name = dict(known)
    found = [Source(_named(name), path, of_name[name]) for name, path in shown if name in of_name]
    used = {path for each in found for path in (each.photo, each.depth)}
    return found, [path.name for _, path in (*shown, *known) if path not in used]


def _named(stem: str) -> str:
    """Return the name of a sample: in a WebDataset all after the first dot is the name of a field."""
    return stem.replace(".", "_")


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in _SUFFIXES)


def _split(files: Sequence[Path]) -> tuple[list[tuple[str, Path]], list[tuple[str, Path]]]:
    """Return pictures and depths, each with the name that they have in common."""
    shown: list[tuple[str, Path]] = []
    known: list[tuple[str, Path]] = []
    for path in files:
        name, word = re.fullmatch(r"(?:(.*)[-_])?([^-_]*)", path.stem, re.DOTALL).groups()  # type: ignore[union-attr]
        is_depth, is_picture = name and word.lower() in _OF_DEPTH, name and word.lower() in _OF_PICTURE
        (known if is_depth else shown).append((name if is_depth or is_picture else path.stem, path))
    return shown, known


def synthesize(sources: Sequence[Source], folder: Path, out: Path, wanted: Synthesis, workers: int) -> tuple[int, dict[str, str]]:
    """Make what is missing of a set, and return (samples that it has now, why others have none, by name).

    Raises InputError if OUT was made with other settings, or if nothing can be made.
    """
    if any(one == other or one in other.parents for one, other in ((folder.resolve(), out.resolve()), (out.resolve(), folder.resolve()))):
        raise InputError(f"{out} and {folder} lie in one another: give --out a place of its own")
    _claim(out, wanted, folder, sources)
    for left in (*out.glob(".shard.*"), *out.glob(".h5.*"), *out.glob(".*.part")):
        shutil.rmtree(left, ignore_errors=True)
    size = wanted.shard if wanted.format == "webdataset" else 1
    parts = [sources[first : first + size] for first in range(0, len(sources), size)]
    missing = [(index, part) for index, part in enumerate(parts) if not _part_path(out, wanted, index, part).exists()]
    failed: dict[str, str] = {}
    with progress_bars() as bars:
        task = bars.add_task("samples", total=len(sources), completed=len(sources) - sum(len(part) for _, part in missing))
        for count, why in _made(out, wanted, missing, workers):
            failed |= why
            bars.advance(task, count)
    if len(failed) == len(sources):
        (out / RECORD).unlink()
        raise InputError(f"{folder}: no picture could be blurred: {next(iter(failed.values()))}")
    return len(sources) - len(failed), failed


def remove_set(out: Path) -> None:
    """Remove what an earlier run has made, and nothing else."""
    for name in read_json(out / RECORD, "what a set was made with")["samples"]:
        shutil.rmtree(out / name, ignore_errors=True)
        (out / f"{name}.h5").unlink(missing_ok=True)
    for shard in out.glob("[0-9]" * 6 + ".tar"):
        shard.unlink()
    write_json(out / RECORD, {"samples": {}})


def _made(
    out: Path, wanted: Synthesis, missing: Sequence[tuple[int, Sequence[Source]]], workers: int
) -> Iterator[tuple[int, dict[str, str]]]:
    """Make parts, and yield (samples of one, why some have failed) as they end."""
    if workers == 1 or len(missing) == 1:
        yield from ((len(part), _make_part(out, wanted, index, part)) for index, part in missing)
        return
    with ProcessPoolExecutor(max(1, min(workers, len(missing))), get_context("spawn")) as pool:
        running = {pool.submit(_make_part, out, wanted, index, part): len(part) for index, part in missing}
        yield from ((running[done], done.result()) for done in as_completed(running))


def _claim(out: Path, wanted: Synthesis, folder: Path, sources: Sequence[Source]) -> None:
    """Note what the set is made of, or raise InputError if it holds another. New pictures may come, but not into shards."""
    samples = {each.name: [_stamp(path) for path in (each.photo, each.depth) if path is not None] for each in sources}
    lens = None if wanted.lens is None or not wanted.lens.exists() else _stamp(wanted.lens)
    record = json.loads(json.dumps({"lens_file": lens, **asdict(wanted)}, default=str))
    if (out / RECORD).exists():
        earlier = read_json(out / RECORD, "what a set was made with")
        before = earlier.get("samples", {})
        kept = samples if wanted.format == "webdataset" else {name: samples.get(name, each) for name, each in before.items()}
        is_same = kept == before
        if not is_same or earlier.get("settings", record) != record:
            raise InputError(f"{out} was made with other settings or pictures (see {RECORD} in it): give another --out, or --overwrite")
        samples = before | samples
    elif out.exists() and any(out.iterdir()):
        raise InputError(f"{out} holds files of something else: give a new folder as --out")
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / RECORD, {"source": str(folder.resolve()), "settings": record, "samples": samples})


def _stamp(path: Path) -> str:
    """Return what changes with a file, of a folder with the files in it."""
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    told = [(each.name, each.stat().st_size, each.stat().st_mtime_ns) for each in files]
    return hashlib.sha256(repr(told).encode()).hexdigest()


def _part_path(out: Path, wanted: Synthesis, index: int, part: Sequence[Source]) -> Path:
    names = {"folders": part[0].name, "webdataset": f"{index:06d}.tar", "hdf5": f"{part[0].name}.h5"}
    return out / names[wanted.format]


def _make_part(out: Path, wanted: Synthesis, index: int, part: Sequence[Source]) -> dict[str, str]:
    """Make a part, and return why samples of it have failed, by name; a shard is written whole or not at all."""
    path, failed = _part_path(out, wanted, index, part), {}
    if wanted.format == "folders":
        failed = _failures(part, lambda source: _write_folder(source, wanted, path))
    elif wanted.format == "hdf5":
        failed = _failures(part, lambda source: _write_hdf5(source, wanted, path))
    else:
        with tempfile.TemporaryDirectory(dir=out, prefix=".shard.") as scratch:
            failed = _failures(part, lambda source: _write_folder(source, wanted, Path(scratch) / source.name))
            if not failed:
                _write_shard(sorted(Path(scratch).iterdir()), path)
    if failed and len(part) > 1:
        failed |= {each.name: f"its shard waits for {', '.join(failed)}" for each in part if each.name not in failed}
    return failed


def _failures(part: Sequence[Source], make: Callable[[Source], None]) -> dict[str, str]:
    failed = {}
    for source in part:
        try:
            make(source)
        except InputError as error:
            failed[source.name] = str(error)
    return failed


def _write_folder(source: Source, wanted: Synthesis, folder: Path) -> None:
    """Write a FocalStack folder, and coc/00.exr and so on: signed diameters in pixels."""
    given, renderer = lens_and_renderer(wanted.lens, wanted.renderer, threads=1)
    sharp = open_sharp(source.photo, source.depth, wanted.depth)
    lens = (given or Lens.default()).stating(dict(wanted.facts))
    distances_m = focus_distances_m(lens, sharp, wanted)
    metadata = {MADE: {"photograph": source.photo.name, "depth": sharp.depth.note, "lens": lens_to_json(lens)}}
    with atomic_folder(folder) as making:
        layers = [sharp.layer]
        write_made_stack(
            making, sharp, lens, distances_m, lambda each: renderer.render(layers, lens.focused_at(each)).rgb, metadata, half=True
        )
        (making / "coc").mkdir()
        for number, distance_m in enumerate(distances_m):
            coc_px = lens.focused_at(distance_m).coc_px(sharp.depth.depth_m, sharp.depth.depth_m.shape[1])
            write_exr(making / "coc" / f"{number:02d}.exr", ExrPart({"coc_px": coc_px.astype(np.float16)}))


def focus_distances_m(lens: Lens, sharp: SharpPhotograph, wanted: Synthesis) -> tuple[float, ...]:
    """Return the focus distances of a sample: as typed, or evenly in dioptres over the depth that its picture has."""
    if wanted.focus is not None:
        return parse_focus(wanted.focus, FocusLookup(lens, sharp.depth.depth_m))
    known = sharp.depth.dioptres[sharp.depth.valid]
    far, near = np.percentile(known if known.size else sharp.depth.dioptres, [_FARTHEST_SHARE, _NEAREST_SHARE])
    if not near > far:
        raise InputError(f"the depth ({sharp.depth.note}) is the same everywhere, so that no range of focus follows from it: give --focus")
    return tuple(1.0 / each if each > 0.0 else float("inf") for each in np.linspace(near, far, wanted.slices).tolist())


def _write_shard(folders: Sequence[Path], path: Path) -> None:
    """Write a WebDataset: the files of each sample under one key, without dates and owners, so that it is the same every time."""
    with atomic_path(path) as temporary, tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:
        for folder in folders:
            for file in sorted(each for each in folder.rglob("*") if each.is_file()):
                # Everything after the first dot is the name of the field.
                name = (
                    "json"
                    if file.name == FILE_NAME
                    else f"{'_'.join(file.relative_to(folder).with_suffix('').parts).replace('.', '_')}.exr"
                )
                entry = tarfile.TarInfo(f"{folder.name}.{name}")
                entry.size = file.stat().st_size
                tar.addfile(entry, io.BytesIO(file.read_bytes()))


def _write_hdf5(source: Source, wanted: Synthesis, path: Path) -> None:
    """Write slices, all_in_focus (linear), depth_m, valid and coc_px of a sample, with stack.json as an attribute."""
    try:
        import h5py
    except ImportError:
        raise MissingExtraError("h5py", "hdf5") from None
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".h5.") as scratch:
        folder = Path(scratch) / source.name
        _write_folder(source, wanted, folder)
        document = read_json(folder / FILE_NAME, "a focal stack")
        slices = [read_exr(folder / each["path"])[0].stacked("RGB").astype(np.float16) for each in document["slices"]]
        depth = read_exr(folder / "depth.exr")[0].channels
        coc_px = [read_exr(each)[0].channels["coc_px"] for each in sorted((folder / "coc").iterdir())]
        with atomic_path(path) as temporary, h5py.File(temporary, "w", track_order=True) as file:
            arrays = {
                "slices": np.stack(slices),
                "all_in_focus": read_exr(folder / "all_in_focus.exr")[0].stacked("RGB").astype(np.float16),
                "depth_m": depth["Z"],
                "valid": depth["confidence"] > 0,
                "coc_px": np.stack(coc_px),
            }
            for name, values in arrays.items():
                file.create_dataset(name, data=values, compression="gzip", compression_opts=1, shuffle=True, track_times=False)
            file.attrs["stack"] = json.dumps(document)
