"""Rendering of a shot from beginning to end: an executor renders the missing segments, then they are joined.

Finished segments lie in a folder beside the result, with a manifest of their settings; a segment is never rendered twice.

Targets are numbered pictures, and videos out of parts that are encoded on their own and joined packet by packet.
Numbered EXR is linear in half, PNG and TIFF are 16-bit sRGB.

Parts of a video are in the final encoding already, so that joining takes no time and no light away. That needs groups of pictures that
do not refer to others (each part begins with a keyframe, and H.265 is told to close its groups) and encoders whose output does not
depend on who runs them (one thread). The cut into segments never depends on the number of workers, so neither does the file: for
ProRes, DNxHR and FFV1, where every picture stands alone, it is the one that would be written in one go; H.264 and H.265 get a keyframe
at every segment.
"""

import hashlib
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh import __version__
from mrbokeh.images.alpha_io import HOLDING_ALPHA, exr_part, in_named_space, write_finished
from mrbokeh.images.carried_exr import CarriedExr
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import ExrPart, header_of, write_exr
from mrbokeh.images.image_io import INTEGER_SUFFIXES
from mrbokeh.images.layer import Layer
from mrbokeh.shots.claims import claimed
from mrbokeh.shots.executors import CLAIM, Executor, Progress, SegmentTask
from mrbokeh.shots.inputs import Kept
from mrbokeh.shots.proxies import picked
from mrbokeh.shots.shot import MANIFEST, PartSink, Picture, Rgba, Segment, Shot
from mrbokeh.stacks.exr_layers.cryptomatte import cryptomatte_among
from mrbokeh.stacks.exr_layers.sequence import ExrSequence
from mrbokeh.system.atomic_files import read_json, refuse_existing, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import channel
from mrbokeh.video.encodings import encoding_for, encoding_name, with_alpha
from mrbokeh.video.image_sequence import NumberedFiles, is_pattern, numbered, written_frames
from mrbokeh.video.picture_source import PictureSource
from mrbokeh.video.proxy_source import ProxySource
from mrbokeh.video.writer import PacketWriter, StreamFacts, VideoWriter, packets_of

_EXR = ".exr"
_THREADS = 1
_POLL_S = 0.25


def in_space(picture: Picture, space: NamedSpace | None) -> Picture:
    """Return the picture in a named colour space; None leaves linear Rec.709.

    Curves are for straight colour: pictures with coverage are divided by it before them and multiplied after; light without coverage is
    lost.
    """
    if isinstance(picture, (Layer, Rgba)):
        return replace(picture, rgb=in_named_space(picture.rgb, picture.alpha, space))
    return in_named_space(picture, None, space)


@dataclass(frozen=True)
class SequenceTarget:
    """A Target. first_number: of the clip's frame 0, whether it is taken or not. layers: what is written is layers.

    space: what the numbers of the pictures are; None is linear Rec.709 in EXR and sRGB in integers. renders: files, numbered or not, whose
    Cryptomatte is written into EXR.
    """

    path: Path
    first_number: int = 0
    layers: bool = False
    space: NamedSpace | None = None
    renders: tuple[Path, ...] = ()

    @property
    def settings(self) -> dict[str, str]:
        numbers = f"{self.first_number} layers={self.layers}"
        return {"container": self.path.name, "numbers": numbers, "output space": str(self.space or "")}

    def parts_name(self, taken: Sequence[int]) -> str:
        """Name the folder by the frames too, so that many may write parts of one sequence at once."""
        first, last = self.first_number + taken[0], self.first_number + taken[-1]
        some = "" if last - first + 1 == len(taken) else f".{len(taken)}"
        return f"{self.path.name}.{first}-{last}{some}.parts"

    @property
    def lacks_alpha(self) -> str | None:
        suffix = self.path.suffix.lower()
        return None if suffix in HOLDING_ALPHA else f"{suffix} cannot hold it (write .exr, .png or .tif)"

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        suffix = self.path.suffix.lower()
        if suffix != _EXR and (self.layers or suffix not in INTEGER_SUFFIXES):
            expected = _EXR if self.layers else f"{_EXR}, {', '.join(INTEGER_SUFFIXES)}"
            raise InputError(f"cannot write {self.path}: expected numbered {expected}, not {suffix or 'files without suffix'}")
        if suffix != _EXR and self.space is not None and self.space.is_linear:
            raise InputError(
                f"{self.path}: {self.space.name} is linear light, which integers cut off at 1: write .exr, or name a space with a curve"
            )
        for index in shot.taken:
            refuse_existing(self.file(index), overwrite)

    def part(self, folder: Path, segment: Segment) -> Path:
        return folder / f"{segment.number:05d}.json"

    @contextmanager
    def writing(self, shot: Shot, segment: Segment, folder: Path) -> Iterator[PartSink]:
        yield _SequenceSink(self, shot.source)
        write_json(self.part(folder, segment), {"frames": list(segment.taken)})

    def join(self, shot: Shot, folder: Path) -> str:  # noqa: ARG002
        channel().outputs.extend(self.file(index) for index in shot.taken)  # workers have channels of their own
        return "no audio"

    def file(self, index: int) -> Path:
        """Return the file of a frame of the clip."""
        return numbered(self.path, self.first_number + index)

    def renders_of(self, index: int) -> list[Path]:
        """Return the renders of a frame, those that are there."""
        sequences = [ExrSequence.of(path, whole=False) for path in self.renders]
        number = self.first_number + index
        return [each.path_of(number) for each in sequences if each.is_still or number in each.paths]


def _cryptomatte_of(width_px: int, height_px: int, *names: str) -> ExrPart | None:
    found = cryptomatte_among([Path(name) for name in names])
    if found is None:
        return None
    return replace(found, channels={name: picked(plane, (width_px, height_px)) for name, plane in found.channels.items()})


@dataclass(frozen=True)
class _SequenceSink:
    target: SequenceTarget
    source: PictureSource
    objects: Kept[..., ExrPart | None] = field(default_factory=lambda: Kept(_cryptomatte_of))

    def write(self, picture: Picture, index: int, time_s: float) -> None:  # noqa: ARG002
        path, space = self.target.file(index), self.target.space
        rgb, alpha = (picture.rgb, picture.alpha) if isinstance(picture, (Rgba, Layer)) else (picture, None)
        if path.suffix.lower() != _EXR:
            write_finished(path, rgb, alpha, space)
            return
        part = exr_part(in_named_space(rgb, alpha, space), alpha, space)
        if isinstance(picture, Layer):
            part = replace(part, channels={**part.channels, "Z": picture.depth_m})
        if (objects := self.objects(rgb.shape[1], rgb.shape[0], *map(str, self.target.renders_of(index)))) is not None:
            part = replace(part, channels={**part.channels, **objects.channels}, attributes={**part.attributes, **objects.attributes})
        write_exr(path, self._carried(index).onto(part, space))

    def _carried(self, index: int) -> CarriedExr:
        """Return what the plate has beside this frame, with its rate and timecode; layers alone and proxies have no overscan."""
        carried, timecode = CarriedExr.of(self.source.file_of(index), self.source.space), self.source.timecode_of(index)
        stated = {"framesPerSecond": self.source.info.frame_rate, "timeCode": None if timecode is None else timecode.to_exr()}
        attributes = {name: value for name, value in stated.items() if value is not None} | dict(carried.attributes)
        if isinstance(self.source, ProxySource):
            return CarriedExr(attributes)
        around = replace(carried, margins_px=(0, 0, 0, 0), rgb=None, alpha=None) if self.target.layers else carried
        return replace(around, attributes=attributes)


@dataclass(frozen=True)
class VideoTarget:
    """A Target. encoding: a name in ENCODINGS or None for the usual one of the suffix; audio_from: a video whose sound is copied.

    space: what the codes are, where it is not BT.709 as the tags say then. even_rate: pictures per second of the result; at each of its
    times it shows the nearest picture of the shot, which is held or left out for that.
    """

    path: Path
    encoding: str | None = None
    audio_from: Path | None = None
    space: NamedSpace | None = None
    even_rate: Fraction | None = None

    @property
    def settings(self) -> dict[str, str]:
        return {
            "encoding": repr(encoding_for(self.path, self.encoding)),
            "container": self.path.suffix.lower(),
            "output space": str(self.space or ""),
            "even rate": str(self.even_rate or ""),
        }

    def parts_name(self, taken: Sequence[int]) -> str:  # noqa: ARG002
        return f"{self.path.name}.parts"

    @property
    def lacks_alpha(self) -> str | None:
        if encoding_for(self.path, self.encoding).alpha:
            return None
        keeping = with_alpha(self.path)
        instead = ".mov, .mkv or frames.%04d.exr" if keeping is None else f"--encoding {keeping}"
        return f"{encoding_name(self.path, self.encoding)} cannot hold it (write {instead})"

    def require_new(self, shot: Shot, overwrite: bool) -> None:
        refuse_existing(self.path, overwrite)
        encoding = encoding_for(self.path, self.encoding)
        if self.space is not None and self.space.is_linear:
            told = f"{self.space.name} is linear light, which codes of a video cannot hold"
            raise InputError(f"{self.path}: {told}: write frames.%04d.exr, or name a space with a curve")
        if self.even_rate is not None and not encoding.stands_alone:
            told = f"--constant-rate needs pictures that stand alone, but those of {encoding.codec} refer to others"
            raise InputError(f"{self.path}: {told}: take another --encoding")
        writer = VideoWriter(self.path, *self._format(shot), encoding=self.encoding)
        if self.path.suffix.lower() == ".mxf" and self.even_rate is None:
            for segment in shot.segments:
                for time_s in shot.times_s(segment):
                    writer.next_tick(time_s)

    def part(self, folder: Path, segment: Segment) -> Path:
        suffix = self.path.suffix.lower()
        return folder / f"{segment.number:05d}{encoding_for(self.path, self.encoding).part_suffix(suffix)}"

    @contextmanager
    def writing(self, shot: Shot, segment: Segment, folder: Path) -> Iterator[PartSink]:
        name = encoding_name(self.path, self.encoding)
        settings: dict[str, Any] = {"encoding": name, "threads": _THREADS, "as_codes": self.space is not None}
        with VideoWriter(self.part(folder, segment), *self._format(shot), **settings) as writer:
            yield _VideoSink(writer, self, shot.times_s(segment)[0], segment.taken)

    def join(self, shot: Shot, folder: Path) -> str:
        reordered = max(packets_of(self.part(folder, segment))[1] for segment in shot.segments)
        writer = PacketWriter(
            self.path,
            *self._format(shot),
            encoding=self.encoding,
            audio_from=self.audio_from,
            audio_start_s=shot.begin_s,
            reordered=reordered,
            as_codes=self.space is not None,
            facts=_facts(shot, self.even_rate),
        )
        with writer:
            for segment in shot.segments:
                packets, count = packets_of(self.part(folder, segment))[0], len(segment.taken)
                if len(packets) != count:
                    raise InputError(f"{self.part(folder, segment)} holds {len(packets)} of {count} pictures: delete it and start again")
                writer.append(*self._placed(packets, shot, segment))
        return writer.audio_note

    def _placed(self, packets: list[Any], shot: Shot, segment: Segment) -> tuple[list[Any], list[float]]:
        """Return the packets of a part with the times at which they are shown; for an even rate some come twice and others never."""
        if self.even_rate is None:
            return packets, shot.times_s(segment)
        first = segment.number * shot.segment_frames
        last = first + len(segment.taken)
        shown = enumerate(held_pictures(shot.all_times_s, self.even_rate))
        here = [(packets[picture - first], float(tick / self.even_rate)) for tick, picture in shown if first <= picture < last]
        return [packet for packet, _ in here], [time_s for _, time_s in here]

    def _format(self, shot: Shot) -> tuple[Any, ...]:
        info = shot.source.info
        if self.even_rate is not None:
            return info.width_px, info.height_px, self.even_rate, 1 / (self.even_rate * 1000)
        return info.width_px, info.height_px, info.frame_rate, info.time_base


def _facts(shot: Shot, even_rate: Fraction | None) -> StreamFacts:
    """Return timecode and pixel aspect of the first frame taken; at another rate than the plate's a timecode would count wrongly."""
    first = shot.taken[0]
    path = shot.source.file_of(first)
    aspect = Fraction(header_of(path).get("pixelAspectRatio", 1.0)) if path is not None and path.suffix.lower() == _EXR else Fraction(1)
    same_rate = even_rate in (None, shot.source.info.frame_rate)
    return StreamFacts(shot.source.timecode_of(first) if same_rate else None, aspect.limit_denominator(1000))


def held_pictures(times_s: Sequence[float], rate: Fraction) -> list[int]:
    """Return the picture that is nearest in time at 0, 1/rate, 2/rate and so on, as long as the last of them is shown (1/rate)."""
    shown_s = np.asarray(times_s, np.float64)
    ticks_s = np.arange(max(1, round(shown_s[-1] * rate) + 1)) / float(rate)
    later = np.searchsorted((shown_s[1:] + shown_s[:-1]) / 2, ticks_s, side="right")
    nearest: list[int] = later.tolist()
    return nearest


@dataclass(frozen=True)
class _VideoSink:
    writer: VideoWriter
    target: VideoTarget
    begin_s: float
    taken: Sequence[int]

    def write(self, picture: Picture, index: int, time_s: float) -> None:
        kept = picture.rgb if isinstance(picture, Rgba) and not self.writer.encoding.alpha else picture
        stored = in_space(kept, self.target.space)
        if isinstance(stored, (Layer, Rgba)):
            stored = np.dstack([stored.rgb, stored.alpha])
        rate = self.target.even_rate
        self.writer.write(stored, time_s - self.begin_s if rate is None else float(self.taken.index(index) / rate))


def render_shot(shot: Shot, executor: Executor, *, overwrite: bool = False, progress: Progress = lambda _: None) -> str:
    """Render a shot; return what became of the sound.

    Raises InputError if the result exists, or parts of another run do, unless overwrite. progress: is told of frames as they are made,
    and at once of those that an interrupted run left finished.
    """
    shot.target.require_new(shot, overwrite or shot.was_begun)
    folder = PartsFolder.opened(shot, overwrite)
    missing = folder.missing
    progress(len(shot.taken) - sum(len(segment.taken) for segment in missing))
    executor.run([SegmentTask(shot, segment, folder.path, executor.threads) for segment in missing], progress)
    while folder.is_there:
        with claimed(folder.path / f"join{CLAIM}") as is_ours:
            if is_ours:
                note = shot.target.join(shot, folder.path)
                folder.remove()
                return note
        time.sleep(_POLL_S)
    return "joined by another process"


@dataclass(frozen=True, eq=False)
class PartsFolder:
    """Folder OUT.parts of finished segments, of a sequence one for each range of frames, until the result is whole; its manifest says what
    they were made with.
    """

    path: Path
    shot: Shot

    @classmethod
    def opened(cls, shot: Shot, overwrite: bool = False) -> "PartsFolder":
        """The folder of this shot, with what an interrupted run left in it.

        Raises InputError where it was left by a run with other settings, unless overwrite, which begins anew.
        """
        folder = cls(shot.parts_path, shot)
        manifest, settings = folder.path / MANIFEST, settings_of(shot)
        if manifest.is_file():
            before = read_json(manifest, "the manifest of finished segments")["settings"]
            changed = sorted(name for name in {*before, *settings} if before.get(name) != settings.get(name))
            if changed and not overwrite and folder.holds_parts:
                raise InputError(
                    f"{folder.path} holds finished segments of a run with other settings ({', '.join(changed)}): "
                    f"run with the same to go on, or --overwrite to begin anew"
                )
            if changed:
                folder.remove()
        write_json(manifest, {"settings": settings, "segments": [list(segment.taken) for segment in shot.segments]})
        return folder

    @property
    def missing(self) -> list[Segment]:
        return [segment for segment in self.shot.segments if not self.shot.target.part(self.path, segment).exists()]

    @property
    def holds_parts(self) -> bool:
        """Whether finished parts are there: half files and signs of workers have other names."""
        return any(each.stem.isdigit() and each.suffix != CLAIM for each in self.path.iterdir())

    @property
    def is_there(self) -> bool:
        return (self.path / MANIFEST).is_file()

    def remove(self) -> None:
        """Remove the folder, for others at one blow: none may take a part of it for a missing one."""
        aside = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}")
        with suppress(OSError):
            self.path.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)


def settings_of(shot: Shot) -> dict[str, str]:
    """Return all that the parts depend on, by name; files with their size and the time of their last change."""
    recipe: Any = shot.recipe
    of_recipe = (
        {each.name: repr(getattr(recipe, each.name)) for each in fields(recipe)} if is_dataclass(recipe) else {"recipe": repr(recipe)}
    )
    return {
        "version": __version__,
        "clip": _stamps([shot.source.path]),
        "input space": "" if shot.source.space is None else f"{shot.source.space} {_stamps(shot.source.space.files)}",
        "frames": f"{written_frames(shot.taken)} by {shot.segment_frames} at {shot.source.info.frame_rate}",
        "size": f"{shot.source.info.width_px}x{shot.source.info.height_px}",
        **of_recipe,
        "files": _stamps(recipe.files),
        **shot.target.settings,
    }


def _stamps(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        for file in NumberedFiles.found(path).files if is_pattern(path) else [path]:
            try:
                status = file.stat()
            except OSError:
                raise InputError(f"expected a file at {file}, but there is none: check the name") from None
            digest.update(f"{file}|{status.st_size}|{status.st_mtime_ns}\n".encode())
    return f"{', '.join(path.name for path in paths)} {digest.hexdigest()[:16]}"
