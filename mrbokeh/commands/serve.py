"""`mrbokeh serve`: a warm process that blurs for compositors on this machine; docs/hosts.md describes its requests.

Only 127.0.0.1 is listened at, and only who can read the connection file (port and token) is answered. HTTP threads put requests into
a queue; the main thread blurs one after the other, so that Ctrl-C ends it as any command.
"""

import hmac
import json
import os
import secrets
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Thread
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from mrbokeh.hosts.client import Refused, ask, connection_file
from mrbokeh.system.errors import InputError, fault_in, mistake_in
from mrbokeh.system.messages import apart, channel, finished, say, tell, unfinished

if TYPE_CHECKING:
    from mrbokeh.commands._insertion_options import LensFacts
    from mrbokeh.images.layer import Layer
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.base import Renderer

FORMAT = "mrbokeh-server"
PREFIX = "mrbokeh-"
"""Beginning of the names of files into which arrays are written, so that no request spoils a photograph."""
_LARGEST_REQUEST_BYTES = 1 << 20
_SILENT_S = 10.0
_KEPT_RENDERERS = 8
_COMMON = ("what", "picture", "depth", "lens", "focal_length_mm", "f_number", "sensor_width_mm", "focus", "renderer", "exact_depth", "out")
_KEYS = {"render": (*_COMMON, "overwrite"), "composite": (*_COMMON, "overwrite", "insert", "slice", "at_pixel", "height", "mode")}
_DTYPES = ("float32", "float16")
_LARGEST = 1e9
"""Millimetres, metres and pixels of requests are smaller; squares of more would not be numbers."""

app = typer.Typer(add_completion=False)


@app.command("serve")
def serve(
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 takes a free one.")] = 0,
    connection: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Where port and token are written, readable to you alone. Default: in your home folder."),
    ] = None,
) -> None:
    """Blur for compositors on this machine until Ctrl-C, with compiled code and lenses kept from one request to the next.

    `mrbokeh host blender` (nuke, natron, fusion) writes what asks it from there.

    Example: mrbokeh serve
    """
    path = connection or Path(connection_file())
    _require_free(path)
    token, queue = secrets.token_urlsafe(24), Queue[_Job]()
    try:
        listening = _Listening(("127.0.0.1", port), _Handler)
    except OSError as error:
        raise InputError(f"cannot listen at port {port} of 127.0.0.1 ({error.strerror}): leave --port out, or choose another") from None
    with listening:
        listening.token, listening.queue = token, queue
        _write_connection(path, {"format": FORMAT, "port": listening.server_port, "token": token})
        unfinished(path)  # so that it goes however this ends
        with suppress(ValueError):  # not the main thread
            interrupt = signal.getsignal(signal.SIGINT)  # in the background of a script it is ignored
            signal.signal(signal.SIGTERM, interrupt if callable(interrupt) else signal.default_int_handler)
        try:
            Thread(target=listening.serve_forever, daemon=True).start()
            tell(f"blurring for programs on this machine: port {listening.server_port}, token in {path}; Ctrl-C ends it")
            _work(queue, Blurring())
        finally:
            with suppress(OSError):
                path.unlink()
            finished(path, None)


def _require_free(path: Path) -> None:
    """Raise InputError if the connection file is something else, or another server answers by it."""
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.system.atomic_files import read_json

    require_suffix(path, (".json",), "--connection")
    if not path.exists():
        return
    document = read_json(path, "the connection file of an earlier `mrbokeh serve`, or none")
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(f"{path} is no connection file of an earlier `mrbokeh serve`: give --connection another name")
    with suppress(Refused):
        ask({}, str(path), longest_s=5.0)
        raise InputError(f"another `mrbokeh serve` is running by {path}: use that, or give this one --connection OTHER.json")


def _write_connection(path: Path, document: dict[str, Any]) -> None:
    from mrbokeh.system.atomic_files import atomic_path

    with atomic_path(path, is_result=False) as temporary:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(document, file)


@dataclass
class _Job:
    """A request that waits for its answer."""

    request: dict[str, Any]
    status: int = 200
    answer: dict[str, Any] = field(default_factory=dict)
    done: Event = field(default_factory=Event)


class _Listening(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = os.name != "nt"  # there another process could listen at the same port
    token: str
    queue: "Queue[_Job]"


class _Handler(BaseHTTPRequestHandler):
    """A caller, who is told to go unless the token is right."""

    server: _Listening
    timeout = _SILENT_S

    def do_POST(self) -> None:
        told = (self.headers.get("Authorization") or "").encode("latin-1", "replace")
        # Of a page in a browser that some name led here the host is that name.
        here = (self.headers.get("Host") or "").partition(":")[0] in ("127.0.0.1", "localhost")
        if not here or not hmac.compare_digest(told, f"Bearer {self.server.token}".encode()):
            return self._answer(403, {"error": "the token is not that of this server: read it from the connection file that it named"})
        try:
            length = int(self.headers.get("Content-Length") or 0)
            if not 0 <= length <= _LARGEST_REQUEST_BYTES:
                raise ValueError(f"it has {length} bytes")
            request = json.loads(self.rfile.read(length).decode("utf-8"))
        except (ValueError, RecursionError) as error:
            return self._answer(400, {"error": f"expected a request as JSON, but {error}: compare with docs/hosts.md"})
        if not isinstance(request, dict):
            return self._answer(400, {"error": f"expected a request as a JSON object, got {str(request)[:80]}: compare with docs/hosts.md"})
        if not request:
            from mrbokeh import __version__

            return self._answer(200, {"mrbokeh": __version__, "waiting": self.server.queue.qsize()})
        job = _Job(request)
        self.server.queue.put(job)
        job.done.wait()
        return self._answer(job.status, job.answer)

    def _answer(self, status: int, answer: dict[str, Any]) -> None:
        body = json.dumps(answer).encode("utf-8")
        with suppress(OSError):  # of a caller who has gone
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Say nothing: what was done is said by the thread that does it."""


def _work(queue: "Queue[_Job]", blurring: "Blurring") -> None:
    count = 0
    while True:
        channel().kept = f"stopped: {count} picture{'' if count == 1 else 's'} blurred"
        try:
            job = queue.get(timeout=0.5)  # Ctrl-C is not noticed in an endless wait on every system
        except Empty:
            continue
        job.status, job.answer = _answered(blurring, job.request)
        count += job.status == 200
        if error := job.answer.get("error"):
            say(f"refused: {error}")
        else:
            width_px, height_px = job.answer["size"]
            say(f"{job.request['what']} {width_px}x{height_px} in {job.answer['seconds']:.2f} s: {job.answer['out']}")
        job.done.set()


def _answered(blurring: "Blurring", request: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Return HTTP status and answer; whatever goes wrong becomes a sentence."""
    begun_s, quiet = perf_counter(), channel().quiet
    with apart() as heard:
        heard.quiet = quiet
        try:
            answer = blurring.answer(request)
        except Exception as error:
            mistake = mistake_in(error)
            return (400, {"error": mistake}) if mistake else (500, {"error": fault_in(error)})
    return 200, {**answer, "warnings": heard.warnings, "guessed": heard.guessed, "seconds": round(perf_counter() - begun_s, 4)}


class Blurring:
    """Answers requests; keeps what it read of lenses, and their renderers, until their files change."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str], tuple[list[int], Any]] = {}

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Blur as a request says and return its answer. Raises InputError."""
        from mrbokeh.commands.on_arrays import composite, render

        asked = _Asked(request)
        held, renderer = self._optics(asked)
        write = asked.writer()
        focus = asked.focus()
        if asked.what == "render":
            lens = asked.facts().on(getattr(renderer, "lens", None) if held is None else held, renderer)
            picture, depth_m = asked.picture_and_depth()
            begun_s = perf_counter()
            rgb = render(picture, depth_m, lens, focus=focus, renderer=renderer, exact_depth=asked.exact_depth)
            facts = (lens.focused_at(focus) if isinstance(focus, float) else lens).facts
        else:
            own, begun_s = asked.facts(), perf_counter()
            used = own.on(held, renderer) if held is not None or own.given else None
            rgb = composite(
                asked.source("picture"),
                asked.inserted(),
                used,
                depth_m=asked.source("depth") if "depth" in request else None,
                slice_index=asked.slice_index(),
                focus=focus,
                at_pixel=asked.pixels(),
                height=asked.heights(),
                mode=asked.text("mode") or None,
                renderer=renderer,
                exact_depth=asked.exact_depth,
            )
            facts = {} if used is None else used.facts
        blurred_s = round(perf_counter() - begun_s, 4)
        # JSON has no infinity.
        told = {name: value if np.isfinite(value) else None for name, value in facts.items()}
        return {"out": write(rgb), "size": [rgb.shape[1], rgb.shape[0]], "facts": told, "blur_seconds": blurred_s}

    def _optics(self, asked: "_Asked") -> "tuple[Lens | None, Renderer]":
        from mrbokeh.optics.lens_file import lens_from_json
        from mrbokeh.renderers.choose import files_of, lens_and_renderer, spreads_light

        described = asked.request.get("lens")
        name, renderer = "" if isinstance(described, dict) else asked.text("lens"), asked.text("renderer")
        files = [*(files_of(Path(name)) if name else ()), *(files_of(Path(renderer)) if spreads_light(Path(renderer)) else ())]
        stamps = [file.stat().st_mtime_ns if file.exists() else 0 for file in files]
        if self._kept.get((name, renderer), (None,))[0] != stamps:
            made = lens_and_renderer(Path(name) if name else None, renderer or None)
            self._kept = dict(list(self._kept.items())[1 - _KEPT_RENDERERS :]) | {(name, renderer): (stamps, made)}
        held, spreads = self._kept[name, renderer][1]
        return (lens_from_json(described, "lens of the request"), spreads) if isinstance(described, dict) else (held, spreads)


@dataclass(frozen=True)
class _Asked:
    """A request as it came, whose values are checked where they are taken."""

    request: dict[str, Any]

    def __post_init__(self) -> None:
        known = _KEYS.get(str(self.request.get("what")))
        if known is None:
            raise InputError(f'what: expected "render" or "composite", got {self.request.get("what")!r}')
        unknown, missing = sorted(set(self.request) - set(known)), sorted({"picture", "out"} - set(self.request))
        if unknown or missing:
            raise InputError(f"a request to {self.what} has the keys {', '.join(known)}: missing {missing}, unknown {unknown}")

    @property
    def what(self) -> str:
        return str(self.request["what"])

    @property
    def exact_depth(self) -> bool:
        return bool(self.request.get("exact_depth", False))

    def text(self, key: str) -> str:
        value = self.request.get(key) or ""
        if not isinstance(value, str) or "\0" in value:
            raise InputError(f"{key} of a request: expected a text, got {str(value)[:80]}")
        return value

    def facts(self) -> "LensFacts":
        """Return the facts of the lens that the request states."""
        from mrbokeh.commands._insertion_options import LensFacts

        return LensFacts(*(self._number(name) for name in ("focal_length_mm", "f_number", "sensor_width_mm")))

    def _number(self, key: str) -> float | None:
        value = self.request.get(key)
        if value is not None and not _is_number(value):
            raise InputError(f"{key} of a request: expected a number, got {str(value)[:80]}")
        return None if value is None else float(value)

    def focus(self) -> float | tuple[float, float] | None:
        """Return the focus in metres, or the pixel (x, y) to focus on."""
        value = self.request.get("focus")
        if value == "inf":
            return np.inf
        if isinstance(value, list) and len(value) == 2 and all(map(_is_number, value)):
            return float(value[0]), float(value[1])
        return self._number("focus")

    def slice_index(self) -> int | None:
        value = self.request.get("slice")
        if value is not None and type(value) is not int:
            raise InputError(f"slice of a request: expected a whole number, got {str(value)[:80]}")
        return value

    def pixels(self) -> list[tuple[float, float]] | None:
        """Return the pixels on which GLBs stand: [x, y], or one for each."""
        value = self.request.get("at_pixel")
        pairs = [value] if isinstance(value, list) and value and not isinstance(value[0], list) else value
        if pairs is None:
            return None
        if not isinstance(pairs, list) or not all(
            isinstance(each, list) and len(each) == 2 and all(map(_is_number, each)) for each in pairs
        ):
            raise InputError(f"at_pixel of a request: expected [x, y] or a list of them, got {str(value)[:80]}")
        return [(float(x_px), float(y_px)) for x_px, y_px in pairs]

    def heights(self) -> list[float | str] | None:
        """Return the heights of GLBs: metres, or texts such as "120px"; one, or one for each."""
        value = self.request.get("height")
        if value is None:
            return None
        each = value if isinstance(value, list) else [value]
        if not all(isinstance(one, str) or _is_number(one) for one in each):
            raise InputError(f'height of a request: expected metres or "120px", or a list of them, got {str(value)[:80]}')
        return each

    def picture_and_depth(self) -> tuple[Any, Any]:
        """Return picture and depth; of an EXR alone both, by whatever names its program gives them."""
        from mrbokeh.stacks.exr_layers.render_channels import RenderChannels, layer_of

        picture, depth = self.source("picture"), self.request.get("depth")
        if depth is None and isinstance(picture, Path):
            layer = layer_of(RenderChannels.read(picture))
            return layer.rgb, layer.depth_m
        picture = picture if isinstance(picture, np.ndarray) else _read(picture)
        if isinstance(depth, int | float):
            if not _is_number(depth) or depth <= 0:
                raise InputError(f"depth of a request: expected metres above 0, or depth by the pixel, got {str(depth)[:80]}")
            return picture, np.full(picture.shape[:2], depth, np.float32)
        if depth is None:
            raise InputError("a picture in memory needs depth of the same size: give depth in memory too, a file, or metres")
        return picture, self.source("depth")

    def inserted(self) -> "list[Layer | Path]":
        """Return what is inserted, front first: files, and arrays of R, G, B, A and Z as layers."""
        from mrbokeh.images.layer import Layer

        given = self.request.get("insert")
        if not isinstance(given, list) or not given:
            raise InputError(f"insert of a request: expected a list of GLB files or layers, got {str(given)[:80]}")
        found = [self._source("insert", each) for each in given]
        for each in (each for each in found if isinstance(each, np.ndarray)):
            if each.ndim != 3 or each.shape[2] != 5:
                raise InputError(f"insert of a request: expected layers in memory to have R, G, B, A and Z, got the shape {each.shape}")
        return [each if isinstance(each, Path) else Layer(each[..., :3].copy(), each[..., 3].copy(), each[..., 4].copy()) for each in found]

    def source(self, key: str) -> np.ndarray | Path:
        return self._source(key, self.request.get(key))

    def _source(self, key: str, given: Any) -> np.ndarray | Path:
        """Return the path of a file, or the array that lies in memory."""
        if isinstance(given, str) and given and "\0" not in given:
            return Path(given)
        if not isinstance(given, dict) or set(given) != {"memory", "shape", "dtype"}:
            raise InputError(f'{key} of a request: expected a file, or {{"memory", "shape", "dtype"}}, got {str(given)[:80]}')
        shape, path = given["shape"], _memory(key, given)
        if given["dtype"] not in _DTYPES or not isinstance(shape, list) or not all(type(side) is int and side > 0 for side in shape):
            raise InputError(f"{key} of a request: expected a shape of whole numbers and {' or '.join(_DTYPES)}, got {str(given)[:80]}")
        array = np.fromfile(path, given["dtype"])
        if array.size != int(np.prod(shape)):
            raise InputError(f"{key} of a request: {path} holds {array.size} numbers, but a shape of {shape} was told")
        return array.reshape(shape).astype(np.float32, copy=False)

    def writer(self) -> Callable[[np.ndarray], str]:
        """Return what writes the result and names it. Raises InputError, before the work, where nothing can be written."""
        from mrbokeh.images.exr_io import ExrPart, write_exr
        from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix, write_image
        from mrbokeh.system.atomic_files import require_safe_outputs

        out = self.request["out"]
        if isinstance(out, dict):
            memory = _memory("out", out)

            def write_memory(rgb: np.ndarray) -> str:
                rgb.astype(np.float32, copy=False).tofile(memory)
                return str(memory)

            return write_memory
        if not isinstance(out, str) or not out or "\0" in out:
            raise InputError(f'out of a request: expected a file or {{"memory": FILE}}, got {str(out)[:80]}')
        require_suffix(out, (".exr", *INTEGER_SUFFIXES), "out of a request")
        inserted = self.request.get("insert")
        named = [self.request.get(key) for key in ("picture", "depth", "lens")] + (inserted if isinstance(inserted, list) else [])
        require_safe_outputs(
            (out,), [each for each in named if isinstance(each, str) and "\0" not in each], bool(self.request.get("overwrite"))
        )

        def write_file(rgb: np.ndarray) -> str:
            if Path(out).suffix.lower() == ".exr":  # as `write_image` does, without the tenth of a second that ZIP takes
                write_exr(out, ExrPart({name: rgb[..., i].astype(np.float16) for i, name in enumerate("RGB")}), compress=False)
            else:
                write_image(out, rgb)
            return out

        return write_file


def _read(picture: Path) -> np.ndarray:
    """Read a picture to blur: a render's as `mrbokeh render` does, which refuses NaN, else a photograph."""
    from mrbokeh.commands.on_arrays import read_picture
    from mrbokeh.images.image_io import LINEAR_SUFFIXES, read_linear

    return read_linear(picture) if picture.suffix.lower() in LINEAR_SUFFIXES else read_picture(picture)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and -_LARGEST < value < _LARGEST


def _memory(key: str, given: dict[str, Any]) -> Path:
    """Return the file through which an array is handed over, in shared memory or a temporary folder."""
    from mrbokeh.system.errors import require_file

    path = Path(str(given.get("memory")))
    if not path.name.startswith(PREFIX) or "\0" in str(path):
        raise InputError(f"{key} of a request: expected memory in a file whose name begins with {PREFIX}, got {path}")
    require_file(path, f"{key} of the request, numbers without a header,")
    return path
