"""A camera found and followed in a map that COLMAP made: of a drawn room with known poses; of real pictures (slow)."""

import itertools
import json
import shutil
import tempfile
import time
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.world_axes import inverted, rigid
from tests.support.refusals import refused
from tests.support.textured_room import FOCAL_PX, HEIGHT_PX, WIDTH_PX, picture, room_camera, similarity
from tests.support.told_parts import ImmediateDetections
from tests.support.waiting import wait_until
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.map_tracker import MapLocaliser, MapTracker, matches, pose_in_map, pose_refined
from viewfinder.tracking.phone_rig import angle_deg
from viewfinder.tracking.sparse_map import CACHE_NAME, SparseMap, read_sparse_map
from viewfinder.tracking.tracker import TrackedPose

INTRINSICS = Camera(WIDTH_PX, HEIGHT_PX, (FOCAL_PX, FOCAL_PX), (WIDTH_PX / 2, HEIGHT_PX / 2))
PLACES_M = [(-0.6, -0.3, 0.0), (-0.2, -0.1, 0.2), (0.2, -0.4, 0.0), (0.6, -0.2, 0.1)]


def make_map(folder: Path, pictures: Path, camera_model: str, parameters: str, side_px: int) -> "pycolmap.Reconstruction":
    """COLMAP's own: SIFT, every pair, incremental; the model lies in folder/sparse/0, one core, always the same."""
    (folder / "sparse").mkdir(parents=True)
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model, camera_params=parameters)
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=side_px, num_threads=1, use_gpu=False)
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(
        folder / "database.db", pictures, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, extraction_options=extraction
    )
    pycolmap.match_exhaustive(folder / "database.db", matching_options=pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False))
    return mapped(folder, pictures, [])


def mapped(folder: Path, pictures: Path, names: list[str]) -> "pycolmap.Reconstruction":
    """names: of the pictures to use, none are all."""
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, image_names=names)
    models = pycolmap.incremental_mapping(folder / "database.db", pictures, folder / "sparse", options)
    return max(models.values(), key=lambda model: model.num_reg_images())


def matrix(image: "pycolmap.Image") -> Pose:
    return np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])


def centre(pose: Pose) -> np.ndarray:
    return inverted(pose)[:3, 3]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float, Pose]:
    """(folder of a map of four pictures, metres per unit, the map's axes in metres from the room's)."""
    folder = tmp_path_factory.mktemp("room") / "reconstruction"
    (folder / "images").mkdir(parents=True)
    cameras = {f"{number}.png": room_camera(place) for number, place in enumerate(PLACES_M)}
    for name, camera in cameras.items():
        cv2.imwrite(str(folder / "images" / name), picture(camera))
    model = make_map(folder, folder / "images", "SIMPLE_PINHOLE", f"{FOCAL_PX},{WIDTH_PX / 2},{HEIGHT_PX / 2}", 1000)
    assert model.num_reg_images() == len(PLACES_M)
    poses = {image.name: matrix(image) for image in model.images.values()}
    scale = np.linalg.norm(np.subtract(PLACES_M[0], PLACES_M[3])) / np.linalg.norm(centre(poses["0.png"]) - centre(poses["3.png"]))
    first = rigid(poses["0.png"][:3, :3], poses["0.png"][:3, 3] * scale)
    (folder / "scale.json").write_text(json.dumps({"format": "mrbokeh-scale", "version": 1, "metres_per_unit": scale}))
    return folder, float(scale), inverted(first) @ cameras["0.png"].camera_from_world


@pytest.fixture(scope="module")
def room_map(room: tuple[Path, float, Pose]) -> SparseMap:
    return read_sparse_map(room[0])


def off(found: Pose, true: Pose) -> tuple[float, float]:
    """(degrees, metres between the camera's places)."""
    return angle_deg(found @ inverted(true)), float(np.linalg.norm(centre(found) - centre(true)))


@pytest.mark.parametrize("place_m", [(0.1, -0.2, 0.1), (-0.4, 0.0, 0.3)])
def test_a_new_picture_is_localised(room: tuple[Path, float, Pose], room_map: SparseMap, place_m: tuple[float, float, float]) -> None:
    """Places that no picture of the map was taken from; the room is 3 m deep, a pixel there 8 mm."""
    camera = room_camera(place_m, (0.1, 0.0, 3.0))
    found = MapLocaliser(room_map, INTRINSICS).localise(picture(camera))
    assert found is not None and len(found.points) > 50
    degrees, metres = off(found.camera_from_map @ room[2], camera.camera_from_world)
    assert degrees < 0.15 and metres < 0.01


def test_points_of_the_map_lie_in_the_room(room: tuple[Path, float, Pose], room_map: SparseMap) -> None:
    """On its floor (y = 0.8) or one of its walls (x = 1.5, z = 3.5), the median to 1 cm."""
    room_from_map = inverted(room[2])
    points = room_map.points_m @ room_from_map[:3, :3].T + room_from_map[:3, 3]
    assert np.median(np.abs(points - [1.5, 0.8, 3.5]).min(axis=1)) < 0.01


def test_no_place_without_the_room(room_map: SparseMap) -> None:
    localiser = MapLocaliser(room_map, INTRINSICS)
    grey = np.full((HEIGHT_PX, WIDTH_PX), 90, np.uint8)
    assert localiser.localise(grey) is None
    noise = np.random.default_rng(0).integers(0, 255, grey.shape).astype(np.uint8)
    assert localiser.localise(cv2.GaussianBlur(noise, (0, 0), 2.0)) is None and len(localiser.detect(grey)) == 0


def test_matches_agree_with_their_plain_twin(room_map: SparseMap) -> None:
    rng, few = np.random.default_rng(4), room_map.point_of < 60
    small = SparseMap(room_map.points_m[:60], room_map.descriptors[few], room_map.point_of[few])
    seen = small.descriptors[rng.choice(few.sum(), 40)] + rng.normal(0, 0.03, (40, 128)).astype(np.float32)
    seen = np.maximum(seen, 0) / np.linalg.norm(np.maximum(seen, 0), axis=1, keepdims=True)
    claims: dict[int, tuple[float, int]] = {}
    for feature, descriptor in enumerate(seen):
        distance = np.linalg.norm(small.descriptors - descriptor, axis=1)
        of_point = {int(point): float(distance[small.point_of == point].min()) for point in set(small.point_of.tolist())}
        (nearest, first), (_, second) = sorted(of_point.items(), key=lambda item: item[1])[:2]
        if first < 0.85 * second:
            claims[nearest] = min(claims.get(nearest, (9.0, -1)), (first, feature))
    features, points = matches(seen, small)
    assert {int(point): int(feature) for feature, point in zip(features, points, strict=True)} == {
        point: feature for point, (_, feature) in claims.items()
    }
    assert len(claims) > 15


def test_pose_from_before_agrees_with_pose_from_nothing() -> None:
    """Exact points with a fifth of them wrong; both find the pose to the rounding, and which are wrong."""
    rng = np.random.default_rng(6)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (100, 3))
    camera = room_camera((0.1, 0.2, 0.0))
    xy_px, _ = camera.project(points)
    xy_px[:20] += rng.uniform(10, 60, (20, 2))
    before = room_camera((0.12, 0.19, 0.01)).camera_from_world
    for fit in (pose_in_map(points, xy_px, INTRINSICS), pose_refined(points, xy_px, INTRINSICS, before)):
        assert fit is not None and not fit.inliers[:20].any() and fit.inliers[20:].all()
        assert off(fit.camera_from_world, camera.camera_from_world) == (pytest.approx(0, abs=1e-3), pytest.approx(0, abs=1e-5))
    assert pose_in_map(points[:11], xy_px[:11], INTRINSICS) is None
    assert pose_refined(points[:0], xy_px[:0], INTRINSICS, before) is None


def walk(steps: int) -> list[Camera]:
    return [room_camera((-0.2 + 0.02 * step, -0.2 + 0.005 * step, 0.1), (0.1, 0.0, 3.0)) for step in range(steps)]


def frame(number: int, camera: Camera | None) -> CameraFrame:
    grey = np.full((HEIGHT_PX, WIDTH_PX), 60, np.uint8) if camera is None else picture(camera)
    return CameraFrame(np.repeat(grey[..., None], 3, axis=2), number / 30.0, number)


def test_tracker_between_localisations(room: tuple[Path, float, Pose], room_map: SparseMap) -> None:
    """2 cm a frame, localised in every fifth one; then the lens is covered, then it is found again."""
    localiser = MapLocaliser(room_map, INTRINSICS)
    tracker = MapTracker(localiser, room[2], ImmediateDetections(localiser, every=5), grace_s=0.1)
    for number, camera in enumerate(walk(7)):
        found = tracker.track(frame(number, camera), INTRINSICS)
        assert found is not None and found.captured_s == number / 30.0 and found.quality > 0.5 and found.points > 30
        degrees, metres = off(found.camera_from_world, camera.camera_from_world)
        assert degrees < 0.2 and metres < 0.012
    covered = [tracker.track(frame(7 + number, None), INTRINSICS) for number in range(5)]
    assert covered[0] is not None and covered[0].captured_s == 6 / 30.0 and covered[0].quality < found.quality
    assert covered[4] is None
    again = tracker.track(frame(12, walk(1)[0]), INTRINSICS)
    assert again is not None and off(again.camera_from_world, walk(1)[0].camera_from_world)[1] < 0.012
    tracker.close()


def test_tracker_with_its_thread(room: tuple[Path, float, Pose], room_map: SparseMap) -> None:
    camera, numbers = walk(1)[0], itertools.count()
    shown = frame(0, camera).bgr
    with closing(MapTracker(MapLocaliser(room_map, INTRINSICS), room[2])) as tracker:

        def found() -> TrackedPose | None:
            time.sleep(0.02)
            number = next(numbers)
            return tracker.track(CameraFrame(shown, number / 30.0, number), INTRINSICS)

        wait_until(lambda: found() is not None)
        assert off(found().camera_from_world, camera.camera_from_world)[1] < 0.012


def test_looks_are_kept_and_renewed(room: tuple[Path, float, Pose], room_map: SparseMap, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(room[0], folder)
    shutil.rmtree(folder / "images")
    (folder / "images").mkdir()
    kept = read_sparse_map(folder)
    assert (kept.descriptors == room_map.descriptors).all() and (kept.points_m == room_map.points_m).all()
    doubled = read_sparse_map(folder, 2.0 * room[1])
    assert doubled.points_m == pytest.approx(2.0 * kept.points_m)
    (folder / CACHE_NAME).write_bytes(b"half a file")
    refused("cannot read the picture", read_sparse_map, folder)


def test_wrong_maps(room: tuple[Path, float, Pose], tmp_path: Path) -> None:
    def assert_refused(sentence: str, folder: Path = tmp_path, scale: float | None = 1.0) -> None:
        refused(sentence, read_sparse_map, folder, scale)

    assert_refused("scale of the map", scale=None)
    assert_refused("expected a COLMAP model")
    assert_refused("positive number", room[0], 0.0)
    shutil.copytree(room[0] / "sparse", tmp_path / "sparse")
    assert_refused("expected the pictures")
    (tmp_path / "images").mkdir()
    points = tmp_path / "sparse" / "0" / "points3D.bin"
    whole = points.read_bytes()
    for content, sentence in ((b"\1", "is cut off"), (whole[: len(whole) // 2], "is cut off"), (bytes(8), "no points")):
        points.write_bytes(content)
        assert_refused(sentence)


HELD_OUT = ("0008.jpg", "0027.jpg", "0045.jpg", "0084.jpg")


@pytest.mark.slow
def test_held_out_pictures_of_the_fox(shared_data: Path) -> None:
    """A map of 21 of 25 pictures; the other four as frames of 360x640, against the reconstruction of all 25.

    Distances in shares of the median distance of the map's points. Measured: 0.05 to 0.22 degrees and 0.05 to 0.3 %.
    """
    pictures = shared_data / "multiview" / "fox" / "images"
    folder = Path(tempfile.gettempdir()) / "mrbokeh-fox-map"
    if not (folder / "sparse" / "all" / "points3D.bin").exists():
        shutil.rmtree(folder, ignore_errors=True)
        everything = make_map(folder, pictures, "RADIAL", "", 640)
        names = [image.name for image in everything.images.values() if image.name not in HELD_OUT]
        most = mapped(folder, pictures, names)
        shutil.rmtree(folder / "sparse")
        for name, model in (("0", most), ("all", everything)):
            (folder / "sparse" / name).mkdir(parents=True)
            model.write(folder / "sparse" / name)
        (folder / "images").symlink_to(pictures.resolve())
    truth = {image.name: matrix(image) for image in pycolmap.Reconstruction(folder / "sparse" / "all").images.values()}
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    of_map = {image.name: matrix(image) for image in model.images.values()}
    assert not set(of_map) & set(HELD_OUT) and len(of_map) >= 20
    focal, x, y, k1, k2 = next(iter(model.cameras.values())).params
    camera = Camera(1080, 1920, (focal, focal), (x, y)).resized(360, 640)
    localiser = MapLocaliser(read_sparse_map(folder, 1.0), camera)
    scale, map_from_truth = alignment({name: of_map[name] for name in of_map}, truth)
    errors = []
    for name in HELD_OUT:
        grey = cv2.imread(str(pictures / name), cv2.IMREAD_GRAYSCALE)
        centred = np.array([[focal, 0, x - 0.5], [0, focal, y - 0.5], [0, 0, 1]])
        flat = cv2.undistort(grey, centred, np.array([k1, k2, 0.0, 0.0]))
        found = localiser.localise(cv2.resize(flat, (360, 640), interpolation=cv2.INTER_AREA))
        assert found is not None and len(found.points) >= 50
        expected = truth[name].copy()
        expected[:3, 3] *= scale
        degrees, units = off(found.camera_from_map @ map_from_truth, expected)
        points = localiser.map.points_m @ found.camera_from_map[2, :3] + found.camera_from_map[2, 3]
        errors.append((name, degrees, units / float(np.median(points)), len(found.points)))
    assert max(degrees for _, degrees, _, _ in errors) < 0.3 and max(share for _, _, share, _ in errors) < 0.005


def alignment(of_map: dict[str, Pose], truth: dict[str, Pose]) -> tuple[float, Pose]:
    """(scale, rigid motion) that take the truth's world to the map's, by the camera's places."""
    names = sorted(set(of_map) & set(truth))
    to, start = (np.array([centre(poses[name]) for name in names]) for poses in (of_map, truth))
    scale, rotation = similarity(to, start)
    return scale, rigid(rotation, to.mean(axis=0) - scale * rotation @ start.mean(axis=0))
