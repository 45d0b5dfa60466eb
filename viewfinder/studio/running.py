"""Running studio, from its options to the address of its page."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import mrbokeh
from mrbokeh.optics.lens_library import shipped
from mrbokeh.renderers.choose import read_lens
from mrbokeh.stacks.focal_stack import FILE_NAME
from mrbokeh.system.errors import InputError, require_file
from mrbokeh.system.messages import say
from viewfinder.options import ListeningOptions
from viewfinder.server.endpoint import on_stop, open_endpoint, serving_site
from viewfinder.server.sessions import Role
from viewfinder.studio.desk import Desk
from viewfinder.studio.project import Project, read_project
from viewfinder.studio.site import StudioSite
from viewfinder.studio.state import StudioState

SHIPPED = Path(mrbokeh.__file__).parent / "demo_data" / "objects"
_SUFFIX = ".studio.json"
_CLIPS = (".mp4", ".mov", ".mkv", ".mxf", ".avi", ".webm", ".m4v")


@dataclass(frozen=True)
class StudioOptions:
    """Options of `mrbokeh studio`. photo: may be a project file; None lets the page ask. camera: the track of a clip."""

    photo: Path | None = None
    objects: tuple[Path, ...] = ()
    depth: Path | None = None
    lenses: tuple[Path, ...] = ()
    camera: Path | None = None
    project: Path | None = None
    pictures: Path = Path()
    listening: ListeningOptions = field(default_factory=ListeningOptions)


def project_of(options: StudioOptions) -> Project:
    """Return the project that options name: the one that was kept, or a new one. Raises InputError for files that are not there."""
    photo, path = options.photo, options.project
    if photo is not None and photo.suffix.lower() == ".json":
        if path is not None:
            raise InputError(f"{photo} and --project {path} are both projects: give one of them")
        path, photo = _there(photo, "a project file of `mrbokeh studio`"), None
    elif photo is not None and photo.is_dir() and not (photo / FILE_NAME).is_file():
        raise InputError(f"{photo} is a folder without a merged focal stack ({FILE_NAME}): make one by `mrbokeh capture process`")
    elif photo is not None and not photo.is_dir():
        _there(photo, "a photograph")
    path = path or options.pictures / f"{photo.stem if photo else 'untitled'}{_SUFFIX}"
    is_new = not path.exists()
    project = Project(path) if is_new else read_project(path)
    if options.camera is not None:
        if photo is None or photo.is_dir():
            raise InputError(f"--camera {options.camera} is the track of a clip: give that as PHOTO")
        if (photo, options.camera) != (project.state.clip, project.state.track):
            from viewfinder.studio.clip import clip_state

            project.add(clip_state(photo, options.camera, options.pictures / "studio_files", project.state))
    elif photo is not None and photo.suffix.lower() in _CLIPS:
        raise InputError(f"{photo} is a clip, in which things stand by the track of its camera: give --camera TRACK (`mrbokeh track clip`)")
    elif photo is not None and project.state.photo != photo:
        project.add(StudioState(photo=photo, object=project.state.object, lens=project.state.lens))
    if options.depth is not None and project.state.depth != _there(options.depth, "the depth of the photograph"):
        project.add(
            replace(project.state, depth=options.depth, camera=None, pitch_deg=None, roll_deg=None, camera_height_m=None, measured=None)
        )
    _offer(project, options)
    return replace(project, history=[project.state], place=0) if is_new else project


def _offer(project: Project, options: StudioOptions) -> None:
    """Offer the objects and lenses of the options, and the shipped objects."""
    given = [_there(each, "a GLB file") for each in options.objects]
    for path in given:
        if path.suffix.lower() not in (".glb", ".gltf"):
            raise InputError(f"expected --object to be a .glb file, got {path}: export the object as glTF binary")
    for path in (*given, *sorted(SHIPPED.glob("*.glb"))):
        project.offer(path)
    for path in map(shipped, options.lenses):
        if path.suffix.lower() != ".onnx":
            read_lens(path)
        project.offer(path if path.is_dir() else _there(path, "a lens file"))
    if given and given[0] not in (project.state.object, *(each.object for each in project.state.objects)):
        project.add(replace(project.state, object=given[0], height=None))


def _there(path: Path, expected: str) -> Path:
    require_file(path, expected)
    return path


async def run(project: Project, options: StudioOptions, ready: Callable[[str], object] = lambda _url: None) -> None:
    """Serve a project until Ctrl-C. ready: told the address once it answers."""
    endpoint = open_endpoint(options.listening)
    site = StudioSite(Desk(project, options.pictures), endpoint.access)
    stopped = asyncio.Event()
    on_stop(stopped.set)
    async with serving_site(site, endpoint.host, options.listening.port, endpoint.tls) as url:
        endpoint.announce("studio", url, (Role.CONTROL,))
        say(f"everything is kept in {project.path}; saved pictures go to {options.pictures.absolute()}")
        ready(url)
        await stopped.wait()


def serve(options: StudioOptions) -> None:
    """Serve the studio of the options until Ctrl-C."""
    options.listening.refuse_contradictions()
    if options.pictures.exists() and not options.pictures.is_dir():
        raise InputError(f"--pictures {options.pictures} is a file: expected a folder for what is saved")
    asyncio.run(run(project_of(options), options))
