"""The stages of the demo that capture: from photographs to stacks with depth and a report on them."""

from pathlib import Path

from mrbokeh.demo.stages import Stage


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
    """Optional: where poses cannot be found, depth stays that from focus. `scale` always finds anew, since one that was interrupted
    leaves a scale without calibrated focus."""
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
