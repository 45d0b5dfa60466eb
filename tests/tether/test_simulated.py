"""The simulated camera: its blur is a thin lens's, its files are whole photographs, its focus distance is as coarse as Nikon's."""

import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32

from capture.photos.metadata import read_metadata
from capture.tether.camera_driver import Ability, CameraSettings, Stop
from capture.tether.focus_plan import FocusRange, plan_focus
from capture.tether.simulated_camera import Card, SimulatedCamera, SimulatedScene, nikon_code
from mrbokeh.images.image_io import read_image
from mrbokeh.optics.lens import Lens, film_plane_m

LENS = Lens(35.0, 2.0, 1.0, 23.5)
Picture = Float32[np.ndarray, "height width 3"]


def camera_at(dioptre: float, width_px: int = 160) -> SimulatedCamera:
    camera = SimulatedCamera.for_plan(plan_focus(LENS, FocusRange(0.5, 2.5), width_px))
    camera.home(Stop.near)
    camera.focus_step(camera.motor.focus_steps.steps_at(dioptre))
    return camera


def written(camera: SimulatedCamera, folder: Path) -> Path:
    shot = camera.capture()
    path = folder / shot.name
    path.write_bytes(shot.data)
    return path


def to_centimetre(distance_m: float) -> float | None:
    """Round to whole centimetres; infinity is not stated."""
    return None if math.isinf(distance_m) else round(distance_m, 2)


def test_an_edge_is_blurred_over_its_circle_of_confusion() -> None:
    """A white card at 0.5 m over a dark wall, the focus at 1 m: the card's edge climbs over the width of the circle.

    By hand: 160 / 23.5 px per mm x 17.5 mm x 36.269 mm x 1 D / 1000 = 4.32 px. The integral over a disc of diameter c rises
    with a standard deviation of c / 4 (second moment of a disc), which the row through the edge must show.
    """
    white = Card(0.5, -0.75, -0.75, 0.0, 0.75, seed=1)
    white.__dict__["texture"] = np.full((40, 40, 3), 0.9, np.float32)
    wall = Card(1.0, -0.75, -0.75, 0.75, 0.75, seed=2)
    wall.__dict__["texture"] = np.full((40, 40, 3), 0.1, np.float32)
    row = SimulatedScene((white, wall)).photographed(LENS, 160, 60)[30, :, 1].astype(np.float64)
    slope, place = -np.diff(row), np.arange(1, 160)
    middle = float((place * slope).sum() / slope.sum())
    spread = math.sqrt(float(((place - middle) ** 2 * slope).sum() / slope.sum()))
    assert row[:60] == pytest.approx(0.9, abs=1e-3) and row[100:] == pytest.approx(0.1, abs=1e-3)
    assert middle == pytest.approx(80.0, abs=0.05), "the edge stays where it is"
    # A pixel averages over itself, which adds 1/12.
    assert spread == pytest.approx(math.sqrt((4.32 / 4.0) ** 2 + 1.0 / 12.0), rel=0.05)


def test_breathing_moves_an_edge_outwards() -> None:
    """A card's edge 0.25 of the width right of the middle at infinity focus lies d_s / f times as far out when focused near."""
    card, wall = Card(2.5, -0.75, -0.75, 0.25, 0.75, seed=1), Card(2.5, -0.75, -0.75, 0.75, 0.75, seed=2)
    card.__dict__["texture"], wall.__dict__["texture"] = (np.full((40, 40, 3), each, np.float32) for each in (0.9, 0.1))
    edges = []
    for focus_m in (0.5, math.inf):
        row = SimulatedScene((card, wall)).photographed(LENS.focused_at(focus_m), 160, 60)[30, :, 1].astype(np.float64)
        edges.append(float((np.arange(1, 160) * -np.diff(row)).sum() / (row[0] - row[-1])) - 80.0)
    assert edges[1] == pytest.approx(40.0, abs=0.1) and edges[0] / edges[1] == pytest.approx(500.0 / 465.0, rel=0.005)


def test_each_card_is_sharpest_in_its_focus() -> None:
    from capture.tether.live_view import Spot, sharpness

    spots = {2.0: Spot(0.22, 0.58, 0.2), 1.2: Spot(0.73, 0.44, 0.2), 0.4: Spot(0.5, 0.9, 0.1)}
    frames = {focus: camera_at(focus).preview() for focus in spots}
    values = {focus: [sharpness(spot.cut(frame)) for spot in spots.values()] for focus, frame in frames.items()}
    assert [int(np.argmax([values[focus][index] for focus in spots])) for index in range(3)] == [0, 1, 2]


def test_the_file_is_a_whole_photograph(tmp_path: Path) -> None:
    camera = camera_at(1.2)
    camera.now = lambda: datetime(2026, 1, 2, 3, 4, 5)
    camera.configure(CameraSettings(exposure_time_s=1 / 30, iso=50.0))
    path = written(camera, tmp_path)
    metadata = read_metadata(path)
    assert (metadata.focal_length_mm, metadata.f_number, metadata.iso) == (35.0, 2.0, 50.0)
    assert metadata.exposure_time_s == pytest.approx(1 / 30, rel=1e-4)
    assert metadata.taken_at == datetime(2026, 1, 2, 3, 4, 5)
    assert metadata.sensor is not None and metadata.sensor.width_mm(160, 107) == pytest.approx(23.5)
    rgb = read_image(path)
    assert rgb.shape == (107, 160, 3)
    assert len(np.unique(np.round(rgb[..., 1] * 65535))) > 4000, "16 bit, not 8"


def test_exposure_and_noise(tmp_path: Path) -> None:
    """Twice the time is twice the light; two shots differ by photon noise: sigma^2 = light / 40000 each."""
    camera = camera_at(0.4)
    first, second = (read_image(written(camera, tmp_path)) for _ in range(2))
    camera.configure(CameraSettings(exposure_time_s=1 / 120))
    half = read_image(written(camera, tmp_path))
    assert float(half.mean() / first.mean()) == pytest.approx(0.5, rel=0.005)
    assert float(np.var(first - second)) == pytest.approx(2.0 * float(first.mean()) / 40000.0, rel=0.05)


def test_nikons_code() -> None:
    """v = round(40 log10(d / 0.01)): 68 -> 0.5012 m (exiftool's own example), 80 -> 1 m, 92 -> 1.9953 m."""
    for distance_m, stated_m in ((0.49, 0.501187), (1.0, 1.0), (0.98, 1.0), (2.05, 1.995262), (math.inf, 22387.2)):
        assert nikon_code(distance_m) == pytest.approx(stated_m, rel=1e-4)


@pytest.mark.parametrize("dioptre", [2.0, 1.3, 0.4])
def test_the_stated_distance_is_within_its_quantum(tmp_path: Path, dioptre: float) -> None:
    camera = camera_at(dioptre)
    stated = read_metadata(written(camera, tmp_path)).focus
    true_m = film_plane_m(camera.focused_lens)
    assert stated is not None and stated.origin == "film_plane"
    assert abs(40.0 * math.log10(stated.distance_m / true_m)) <= 0.501, "half of one of Nikon's steps"
    camera.quantum = to_centimetre
    stated = read_metadata(written(camera, tmp_path)).focus
    assert stated is not None and abs(stated.distance_m - true_m) <= 0.005001
    camera.quantum = lambda _: None
    assert read_metadata(written(camera, tmp_path)).focus is None and to_centimetre(math.inf) is None


def test_what_it_says_of_itself() -> None:
    camera = camera_at(2.0)
    description = camera.describe()
    assert description.abilities == {Ability.shutter, Ability.focus_drive, Ability.live_view}
    assert description.focus_steps is not None and description.focus_steps.dioptre_at(camera.counter) == pytest.approx(2.0, abs=1e-3)
    assert camera.motor.dioptre == pytest.approx(2.0, abs=1e-3)
    camera.knows_steps = False
    assert camera.describe().focus_steps is None and camera.preview().shape == (53, 80, 3)
    assert camera.configure(CameraSettings(f_number=4.0))["f-number"] == "4" and camera.focused_lens.f_number == 4.0
