"""Whole stacks: a photographed one and the shipped RAW stack against its truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32
from scipy.ndimage import affine_transform, uniform_filter

from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.stack_ingest import Development
from mrbokeh.images.image_io import read_image
from tests.support.made_photographs import Picture, only_stack, sources

DEMO_STACK = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "raw_stack"


def test_a_real_jpeg_stack(shared_data: Path, tmp_path: Path) -> None:
    """Seven slices; the merged picture of the source's authors beside them names no camera and is left out."""
    report = ingest([shared_data / "stacks" / "pcb_oblique"], tmp_path, IngestSettings(development=Development(max_width=512)))
    stack = only_stack(report)
    assert sources(stack) == [f"{index:02d}.jpg" for index in range(1, 8)]
    assert [each.path.name for each in report.stacks[0].skipped] == ["reference_fused.jpg"]
    assert stack.slice_rgb(0).shape == (384, 512, 3)
    assert stack.slices[0].metadata["exposure_time_s"] == pytest.approx(1 / 126)
    # After evening out, the middle of neighbouring slices is equally bright to the 3 % that its changing content explains.
    middles = [np.median(stack.slice_rgb(index)[96:288, 128:384].mean(axis=-1)) for index in range(7)]
    assert np.ptp(middles) / np.mean(middles) < 0.12
    assert all(0.9 < each.metadata["exposure_gain"] < 1.1 for each in stack.slices)


@pytest.mark.skipif(not (DEMO_STACK / "truth.json").is_file(), reason="the RAW stack with truth is not in mrbokeh/demo_data")
@pytest.mark.slow
def test_the_shipped_raw_stack_matches_its_truth(tmp_path: Path) -> None:
    """All views whole, the lens as stated, and per channel the light of the truth: defocus conserves the mean, so that the
    inner part of each slice, scaled to the reference by its focal length, must have the mean of the sharp truth.

    Half a percent is what is asked of the colour path; blur across the border of the area, noise and the saturated
    lamps (left out with what lies around them) take some of it.
    """
    truth = json.loads((DEMO_STACK / "truth.json").read_text())
    report = ingest([DEMO_STACK], tmp_path)
    assert [each.name for each in report.stacks] == [f"view_{index}" for index in range(truth["plan"]["viewpoints"])]
    for stack in (each.stack for each in report.stacks):
        assert stack is not None
        assert stack.focus_distances_m == pytest.approx(truth["focus_distances_m"], rel=1e-4)
        assert stack.lens is not None
        assert stack.lens.sensor_width_mm == pytest.approx(truth["lens"]["sensor_width_mm"], rel=1e-6)
        sharp = read_image(DEMO_STACK / "truth" / stack.folder.name / "all_in_focus.exr")
        ratios = [mean_ratio(stack.slice_rgb(index), sharp, truth["focal_px"][0] / truth["focal_px"][index]) for index in range(len(stack))]
        assert np.abs(np.array(ratios) - 1.0).max() < 0.005
        assert [each.metadata["exposure_gain"] for each in stack.slices] == [1.0] * len(stack)
        assert [each.metadata["exposure_gain_measured"] for each in stack.slices[1:]] == pytest.approx([1.0] * (len(stack) - 1), abs=0.002)


def mean_ratio(rgb: Picture, sharp: Picture, reference_from_slice: float) -> Float32[np.ndarray, "3"]:
    """Mean of a slice over that of the truth per channel, 40 px inside the border and away from lights above white."""
    height, width = sharp.shape[:2]
    middle = np.array([height / 2 - 0.5, width / 2 - 0.5])
    matrix = np.eye(2) / reference_from_slice
    scaled = np.stack(
        [affine_transform(rgb[..., each], matrix, middle - matrix @ middle, order=1, mode="nearest") for each in range(3)], axis=-1
    )
    inside = np.zeros((height, width), bool)
    inside[40:-40, 40:-40] = True
    inside &= uniform_filter((sharp.max(axis=-1) > 0.9).astype(np.float32), 61) < 1e-6
    return (scaled[inside].mean(axis=0) / sharp[inside].mean(axis=0)).astype(np.float32)
