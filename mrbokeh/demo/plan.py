"""Plan of the demo: the list of its commands, from RAW files to composites."""

from dataclasses import dataclass
from pathlib import Path

from mrbokeh.demo.stages import Stage

DATA = Path(__file__).resolve().parent.parent / "demo_data"
VIEWS = ("view_0", "view_1", "view_2")
HELD_OUT_VIEW = "view_2"
BOARD_VIEWS = ("pcb_oblique",)
QUICK_EVALUATION = ("--renderer", "scatter", "--pull", "0")


@dataclass(frozen=True)
class Placement:
    """An object in one slice of a stack: which slice, which pixel it stands on, how tall it is."""

    name: str
    glb: str
    slice_index: int
    at_pixel: str
    height_m: float
    turn_deg: float
    tilt_deg: float


DESK = (
    Placement(
        name="cake_sharp",
        glb="cakeBirthday.glb",
        slice_index=1,
        at_pixel="330,330",
        height_m=0.075,
        turn_deg=20.0,
        tilt_deg=10.0,
    ),
    Placement(
        name="cake_blurred",
        glb="cakeBirthday.glb",
        slice_index=5,
        at_pixel="330,330",
        height_m=0.075,
        turn_deg=20.0,
        tilt_deg=10.0,
    ),
)


BOARD = (
    Placement(name="alien_sharp", glb="alien.glb", slice_index=0, at_pixel="185,265", height_m=0.012, turn_deg=25.0, tilt_deg=35.0),
    Placement(name="alien_blurred", glb="alien.glb", slice_index=4, at_pixel="185,265", height_m=0.012, turn_deg=25.0, tilt_deg=35.0),
)


def demo_stages(out: Path) -> list[Stage]:
    """Return the stages of both stacks. Networks learn by epochs, not by the clock: a slow or busy machine makes the same ones, later."""
    desk, board = out / "desk", out / "board"
    return [
        *merged_stages(desk, "RAW photographs of a desk (simulated camera, known truth)", DATA / "raw_stack", VIEWS, []),
        *deepened_stages(desk, VIEWS),
        report_stage(desk, VIEWS, "--max-width", "400"),
        *_network(desk, 125, HELD_OUT_VIEW),
        *_composites(desk, desk / "scene" / HELD_OUT_VIEW, DESK),
        *merged_stages(board, "photographs of a circuit board", DATA / "pcb_oblique", BOARD_VIEWS, ["--max-width", "512"]),
        report_stage(board, BOARD_VIEWS),
        *_network(board, 190, None),
        *_composites(board, board / "scene" / "pcb_oblique", BOARD),
    ]


def quick_stages(out: Path) -> list[Stage]:
    """Return the stages of the quick demo: the photographs of a circuit board merged, an object in two of them, no network."""
    merged = merged_stages(out, "photographs of a circuit board", DATA / "pcb_oblique", BOARD_VIEWS, ["--max-width", "512"])
    return [*merged, *(_composite(out, out / "scene" / BOARD_VIEWS[0], placement, "lens") for placement in BOARD)]


def _network(folder: Path, epochs: int, held_out: str | None) -> list[Stage]:
    scene, run, network = folder / "scene", folder / "network", folder / "lens.onnx"
    fit = ["train", "fit", str(scene), "--preset", "demo", "--epochs", str(epochs), "--out", str(run)]
    stages = [
        Stage(
            f"{folder.name}_fit",
            "Train a network that blurs like this lens",
            (*fit, *(["--held-out", held_out] if held_out else [])),
            (run / "network.pt",),
            when_stale=("--overwrite",),
        ),
        Stage(
            f"{folder.name}_export",
            "Write the network as ONNX",
            ("train", "export", str(run), "--out", str(network), "--overwrite"),
            (network, network.with_name(network.name + ".json")),
        ),
    ]
    if held_out:
        evaluate = ("train", "evaluate", str(network), str(scene), "--out", str(folder / "evaluation"), "--overwrite", *QUICK_EVALUATION)
        outputs = (folder / "evaluation" / "evaluation.csv", folder / "evaluation" / "evaluation.png")
        stages.append(
            Stage(f"{folder.name}_evaluate", f"Compare the network with photographs it has not seen ({held_out})", evaluate, outputs)
        )
    return stages


def _composites(folder: Path, stack: Path, placements: tuple[Placement, ...]) -> list[Stage]:
    return [_composite(folder, stack, placement, renderer) for placement in placements for renderer in ("network", "reference")]


def _composite(folder: Path, stack: Path, placement: Placement, renderer: str) -> Stage:
    picture = folder / f"{placement.name}_{renderer}.png"
    blur = {"network": ("--lens", str(folder / "lens.onnx")), "reference": ("--renderer", "scatter"), "lens": ()}[renderer]
    arguments = (
        *("composite", str(stack), "--slice", str(placement.slice_index), "--object", str(DATA / "objects" / placement.glb)),
        *("--at-pixel", placement.at_pixel, "--height", f"{placement.height_m:g}", "--turn", f"{placement.turn_deg:g}"),
        *("--pitch", f"{placement.tilt_deg:g}", *blur),
        *("--save-layer", str(picture.with_suffix(".exr")), "--out", str(picture), "--overwrite"),
    )
    purpose = f"Put {placement.glb} into slice {placement.slice_index} ({folder.name}), blurred by the {renderer}"
    return Stage(f"{folder.name}_{placement.name}_{renderer}", purpose, arguments, (picture, picture.with_suffix(".exr")))


def merged_stages(folder: Path, what: str, source: Path, names: tuple[str, ...], options: list[str]) -> list[Stage]:
    scene = folder / "scene"
    ingest = ("capture", "ingest", str(source), "--out", str(scene), *options)
    return [
        Stage(
            f"{folder.name}_ingest",
            f"Develop {what}",
            ingest,
            tuple(scene / name / "stack.json" for name in names),
            when_stale=("--overwrite",),
        ),
        Stage(
            f"{folder.name}_merge",
            "Register the slices, merge all-in-focus pictures, find depth from focus",
            ("capture", "merge", str(scene)),
            _pictures(scene, names),
            when_stale=("--overwrite",),
        ),
    ]


def deepened_stages(folder: Path, names: tuple[str, ...]) -> list[Stage]:
    """Return stages that find poses, scale and dense depth; optional, since without poses depth stays that from focus.

    `scale` always runs anew, since an interrupted run leaves a scale without calibrated focus.
    """
    scene = folder / "scene"
    reconstruction = scene / "reconstruction"
    depth = Stage(
        f"{folder.name}_depth",
        "Find dense depth from all viewpoints and focus, merge again with it",
        ("capture", "depth", str(scene)),
        _pictures(scene, names),
        when_stale=("--overwrite",),
        optional=True,
    )
    return [
        Stage(
            f"{folder.name}_poses",
            "Find where the cameras stood",
            ("capture", "poses", str(scene)),
            (reconstruction / "poses.json", reconstruction / "points.npz"),
            when_stale=("--overwrite",),
            optional=True,
        ),
        Stage(
            f"{folder.name}_scale",
            "Find metres from the focus distances, calibrate the focus",
            ("capture", "scale", str(scene), "--overwrite"),
            (reconstruction / "scale.json", scene / "lens_calibration.json"),
            optional=True,
        ),
        depth,
    ]


def report_stage(folder: Path, names: tuple[str, ...], *options: str) -> Stage:
    scene = folder / "scene"
    outputs = (scene / "report.html", scene / "report.json", *(scene / name / "exclusion.exr" for name in names))
    return Stage(
        f"{folder.name}_report",
        "Judge the stacks: does the merged picture, blurred, give the photographs?",
        ("capture", "report", str(scene), *options),
        outputs,
    )


def _pictures(scene: Path, names: tuple[str, ...]) -> tuple[Path, ...]:
    return tuple(scene / name / picture for name in names for picture in ("all_in_focus.exr", "depth.exr"))
