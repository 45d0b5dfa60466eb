"""Files of camera tracks: round trips, points whose places in the picture follow from the format's own definition, other readers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.tracking.camera_track.formats import FORMATS, read_track, write_track
from mrbokeh.tracking.camera_track.track import ROTATION_ORDERS, CameraTrack, TrackedFrame, TrackOptions
from tests.support.refusals import refused

SIZE_PX = (640, 360)
NAMES = {"json": "track.json", "chan": "track.chan", "nerfstudio": "transforms.json", "opentrackio": "track.jsonl"}
NAMES |= {"colmap": "model", "colmap-binary": "model_binary"}
RNG_POINTS = np.random.default_rng(3).uniform(-1.0, 1.0, (40, 3))


def moving(*, plain: bool) -> CameraTrack:
    """Seven cameras around the origin. plain: square pixels, centred, no distortion: what a .chan can hold."""
    frames = {}
    for number in range(7):
        turn = Rotation.from_euler("xyz", (0.3 + 0.1 * number, -0.2 * number, 0.4 - 0.05 * number))
        place = turn.apply((0.1 * number, -0.2, -4.0))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.inv().as_matrix(), -turn.inv().apply(place)
        focal, middle = ((510.0 + number,) * 2, (320.0, 180.0)) if plain else ((510.0 + number, 498.0), (317.5, 186.25))
        distortion = None if plain else {"k1": -0.11, "k2": 0.03, "p1": 1e-3, "p2": -2e-3}
        camera = Camera(*SIZE_PX, focal, middle, pose)
        frames[number] = TrackedFrame(camera, 1.0 + 0.1 * number, 2.8, number / 24.0, distortion)
    return CameraTrack(frames, "-z")


def assert_same_views(one: CameraTrack, other: CameraTrack) -> None:
    """The same upright points fall on the same pixels, to a millionth."""
    other = other.with_up(one.up)
    assert other.numbers == one.numbers
    for number in one.numbers:
        told, back = one.at(number), other.at(number)
        np.testing.assert_allclose(back.camera.project(RNG_POINTS)[0], told.camera.project(RNG_POINTS)[0], rtol=0, atol=1e-6)
        assert back.coefficients == pytest.approx(told.coefficients, rel=1e-9)


@pytest.mark.parametrize(("kind", "plain"), [(kind, plain) for kind in FORMATS for plain in (True, False) if plain or kind != "chan"])
def test_round_trips_are_exact(tmp_path: Path, kind: str, plain: bool) -> None:
    """A .chan holds neither distortion nor a principal point: see the next test."""
    track, options = moving(plain=plain), TrackOptions(size_px=SIZE_PX)
    missing = write_track(tmp_path / NAMES[kind], track, options, kind)
    back = read_track(tmp_path / NAMES[kind], options)
    assert_same_views(track, back)
    lens_told = kind in ("json", "opentrackio")
    assert ("focus distances" in missing) is not lens_told
    assert back.at(3).focus_distance_m == (track.at(3).focus_distance_m if lens_told else None)
    assert back.at(3).time_s == (pytest.approx(3 / 24.0, abs=1e-9) if lens_told else None)


def test_what_a_format_cannot_hold_is_told(tmp_path: Path) -> None:
    missing = write_track(tmp_path / "a.chan", moving(plain=False))
    bent = {"lens distortion", "principal points off the middle", "pixels that are not square"}
    assert set(missing) == bent | {"focus distances", "f-numbers", "times"}
    assert write_track(tmp_path / "a.json", moving(plain=False)) == ()


@pytest.mark.parametrize("order", ROTATION_ORDERS)
def test_every_rotation_order_of_a_chan_comes_back(tmp_path: Path, order: str) -> None:
    track, options = moving(plain=True), TrackOptions(size_px=SIZE_PX, rotation_order=order)
    write_track(tmp_path / "a.chan", track, options)
    assert_same_views(track, read_track(tmp_path / "a.chan", options))


def test_chan_by_hand_and_in_its_order_of_rotations(tmp_path: Path) -> None:
    """Nuke: y up, looking along -z. At (0, 1, 5), unturned, 90 degrees high: focal length is half the height, 180 px. A point 2 m
    ahead, 1 m to the right and 0.5 m above the camera lies 90 px right of and 45 px above the middle. Panned by +90 degrees about y
    the camera looks along -x."""
    (tmp_path / "a.chan").write_text("1 0 1 5 0 0 0 90\n\n2 0 1 5 0 90 0 90\n")
    track = read_track(tmp_path / "a.chan", TrackOptions(size_px=SIZE_PX))
    assert track.up == "+y" and track.numbers == [1, 2]
    xy_px, depth_m = track.at(1).camera.project(np.array([[1.0, 1.5, 3.0]]))
    np.testing.assert_allclose(xy_px, [[410.0, 135.0]], atol=1e-9)
    np.testing.assert_allclose(depth_m, [2.0], atol=1e-12)
    np.testing.assert_allclose(track.at(2).camera.world_from_camera[:3, 2], (-1.0, 0.0, 0.0), atol=1e-12)
    # Nuke's ZXY as product of matrices on column vectors: R = Ry Rx Rz, each written out here.
    (tmp_path / "a.chan").write_text("0 0 0 0 20 30 40 45\n")
    x, y, z = np.deg2rad((20.0, 30.0, 40.0))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    pose = read_track(tmp_path / "a.chan", TrackOptions(size_px=SIZE_PX)).at(0).camera.world_from_camera
    np.testing.assert_allclose(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]), about_y @ about_x @ about_z, atol=1e-12)
    (tmp_path / "a.chan").write_text("0 0 0 0 0 0 0 45\n")
    refused("--size", read_track, tmp_path / "a.chan")


def test_nerfstudio_by_hand(tmp_path: Path) -> None:
    """OpenGL's camera at (0, 0, 2) unturned looks down the world's z: the origin is 2 m ahead, and world +y is up in the picture."""
    frame = {"file_path": "images/shot_0007.jpg", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]}
    document = {"w": 200, "h": 100, "camera_angle_x": np.pi / 2, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    track = read_track(tmp_path / "transforms.json")
    assert track.numbers == [7] and track.up == "+z" and not track.metric
    xy_px, depth = track.at(7).camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(xy_px, [[100.0, 50.0], [100.0, 25.0], [150.0, 50.0]], atol=1e-9)
    np.testing.assert_allclose(depth, 2.0)


def test_nerfstudio_of_a_real_capture(shared_data: Path) -> None:
    """instant-ngp's fox: all 67 cameras look at the origin's surroundings, where instant-ngp puts the subject, and stand upright."""
    path = shared_data / "multiview" / "fox" / "transforms.json"
    if not path.is_file():
        pytest.skip("multiview/fox is not in the shared test data")
    track = read_track(path)
    assert track.size_px == (1080, 1920) and len(track.frames) == 67 and track.numbers[:3] == [1, 2, 3]
    assert set(track.at(1).coefficients) == {"k1", "k2", "p1", "p2"}
    for number in track.numbers:
        camera = track.at(number).camera
        xy_px, depth = camera.project(np.zeros((1, 3)))
        assert depth[0] > 0 and np.abs(xy_px[0] - (540, 960)).max() < 960
        assert camera.camera_from_world[1, 2] < -0.8  # the world's z points up in the picture


def test_colmap_by_hand(tmp_path: Path) -> None:
    """A quarter turn about z as COLMAP has it (w first): world x becomes the camera's y. Its pixels are ours."""
    root = float(np.sqrt(0.5))
    (tmp_path / "cameras.txt").write_text("# by hand\n3 SIMPLE_RADIAL 200 100 50 100 50 0.1\n")
    lines = f"1 {root!r} 0 0 {root!r} 0 0 4 3 left eye 9.png\n\n2 1 0 0 0 0 0 4 3 a/10.png\n1 2 -1\n"
    (tmp_path / "images.txt").write_text(f"# by hand\n{lines}")
    track = read_track(tmp_path)
    assert track.numbers == [9, 10]
    np.testing.assert_allclose(track.at(9).camera.project(np.array([[1.0, 0.0, 0.0]]))[0], [[100.0, 62.5]], atol=1e-9)
    np.testing.assert_allclose(track.at(10).camera.project(np.array([[1.0, 0.0, 0.0]]))[0], [[112.5, 50.0]], atol=1e-9)
    assert track.at(9).coefficients == {"k1": 0.1}


@pytest.mark.parametrize("kind", ["colmap", "colmap-binary"])
def test_colmap_itself_reads_what_is_written(tmp_path: Path, kind: str) -> None:
    """pycolmap projects points with our file to where OpenCV's formula puts them, distortion and all."""
    pycolmap = pytest.importorskip("pycolmap")
    cv2 = pytest.importorskip("cv2")
    track = moving(plain=False)
    write_track(tmp_path, track, TrackOptions(up="-z"), kind)
    model = pycolmap.Reconstruction(str(tmp_path))
    images = {image.name: image for image in model.images.values()}
    assert len(images) == 7
    for number in track.numbers:
        frame = track.at(number)
        image = images[f"frame_{number:06d}.png"]
        in_camera = RNG_POINTS @ frame.camera.camera_from_world[:3, :3].T + frame.camera.camera_from_world[:3, 3]
        seen = np.array([image.project_point(point) for point in RNG_POINTS])
        matrix = np.array([[frame.camera.focal_px[0], 0, 317.5], [0, frame.camera.focal_px[1], 186.25], [0, 0, 1]])
        true = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, np.array([-0.11, 0.03, 1e-3, -2e-3]))[0].reshape(-1, 2)
        np.testing.assert_allclose(seen, true, atol=1e-6)


def test_a_model_that_colmap_wrote_is_read(tmp_path: Path) -> None:
    """Also with rigs, frames and points in its files; images and points3D of pycolmap's own making."""
    pycolmap = pytest.importorskip("pycolmap")
    write_track(tmp_path / "ours", moving(plain=False), TrackOptions(up="-z"), "colmap")
    model = pycolmap.Reconstruction(str(tmp_path / "ours"))
    for folder, write in (("binary", model.write_binary), ("text", model.write_text)):
        (tmp_path / folder).mkdir()
        write(str(tmp_path / folder))
        assert_same_views(moving(plain=False), read_track(tmp_path / folder, TrackOptions(up="-z")))


def test_a_cut_off_colmap_model_and_fisheyes_end_in_a_sentence(tmp_path: Path) -> None:
    """Cut anywhere in images.bin; a broken points3D.bin does not matter, for it is not opened."""
    write_track(tmp_path, moving(plain=True), None, "colmap-binary")
    (tmp_path / "points3D.bin").write_bytes(b"\xff" * 8)
    assert len(read_track(tmp_path).frames) == 7
    whole = (tmp_path / "images.bin").read_bytes()
    for length in (0, 5, 8, 30, 80, len(whole) - 1):
        (tmp_path / "images.bin").write_bytes(whole[:length])
        refused("cut off", read_track, tmp_path)
    (tmp_path / "fisheye").mkdir()
    (tmp_path / "fisheye" / "cameras.txt").write_text("1 OPENCV_FISHEYE 200 100 50 50 100 50 0 0 0 0\n")
    (tmp_path / "fisheye" / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.png\n\n")
    refused("OPENCV_FISHEYE: undistort", read_track, tmp_path / "fisheye")


def opentrackio_sample(**lens: object) -> dict[str, object]:
    """A camera 2 m above the stage's origin that looks along +Y; a 36 x 24 mm sensor of 3600 x 2400 px: 100 px a millimetre."""
    resolution = {"activeSensorResolution": {"width": 3600, "height": 2400}}
    return {
        "protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]},
        "static": {"camera": {"activeSensorPhysicalDimensions": {"width": 36.0, "height": 24.0}, **resolution}},
        "transforms": [{"translation": {"x": 0, "y": 0, "z": 2}, "rotation": {"pan": 0, "tilt": 0, "roll": 0}, "id": "Camera"}],
        "timing": {"sampleTimestamp": {"seconds": 1718806554, "nanoseconds": 500000000}},
        "lens": {"pinholeFocalLength": 50.0, "focusDistance": 3.0, "fStop": 2.8, **lens},
    }


def test_opentrackio_by_hand(tmp_path: Path) -> None:
    """5 m ahead, 1 m to the right and 1 m up: 50 mm / 5 = 10 mm, 1000 px right of and above the middle; an offset of the projection
    of 1 mm to the right and 2 mm down moves it by 100 and 200 px."""
    (tmp_path / "a.json").write_text(json.dumps([opentrackio_sample(), opentrackio_sample(projectionOffset={"x": 1.0, "y": 2.0})]))
    track = read_track(tmp_path / "a.json")
    point = np.array([[1.0, 5.0, 3.0]])
    np.testing.assert_allclose(track.at(0).camera.project(point)[0], [[2800.0, 200.0]], atol=1e-9)
    np.testing.assert_allclose(track.at(1).camera.project(point)[0], [[2900.0, 400.0]], atol=1e-9)
    assert track.up == "+z" and (track.at(0).focus_distance_m, track.at(0).f_number, track.at(0).time_s) == (3.0, 2.8, 0.0)


def test_opentrackio_distortion_is_in_millimetres(tmp_path: Path) -> None:
    """Of r^2 with 50 mm: k1 = 2500 l1. The second radial coefficient stands below the bar: OpenCV's k4."""
    distortion = [{"model": "Brown-Conrady U-D", "radial": [-4e-5, 2e-5, 1e-9], "tangential": [2e-5]}]
    (tmp_path / "a.json").write_text(json.dumps(opentrackio_sample(distortion=distortion)))
    told = read_track(tmp_path / "a.json").at(0).distortion
    assert told == pytest.approx({"k1": -0.1, "k4": 0.05, "k2": 0.00625, "p1": 0.001})
    backwards = [{"radial": [-4e-5]}]
    (tmp_path / "a.json").write_text(json.dumps(opentrackio_sample(distortion=backwards)))
    refused("Brown-Conrady D-U", read_track, tmp_path / "a.json")
    assert read_track(tmp_path / "a.json", TrackOptions(keep_distortion=False)).at(0).distortion is None


def test_the_viewfinder_reads_the_same_pose_from_our_samples(tmp_path: Path) -> None:
    """Samples are read by one code; what is the viewfinder's own is its world, which has -z up, as a board does."""
    opentrackio = pytest.importorskip("viewfinder.tracking.socket_tracker")
    track = moving(plain=False)
    write_track(tmp_path / "a.jsonl", track)
    for number, line in enumerate((tmp_path / "a.jsonl").read_text().splitlines()):
        sample = opentrackio.decode_opentrackio(line.encode(), 1)
        np.testing.assert_allclose(sample.camera_from_world, track.at(number).camera.camera_from_world, atol=1e-9)
        assert sample.lens.focus_distance_m == pytest.approx(1.0 + 0.1 * number)


def test_our_file_keeps_everything_and_a_single_camera_is_a_tripod(tmp_path: Path) -> None:
    track = replace(moving(plain=False), metric=False, up="+y")
    frames = {**track.frames, 3: replace(track.at(3), focus_distance_m=float("inf"), f_number=None)}
    write_track(tmp_path / "a.json", replace(track, frames=frames))
    back = read_track(tmp_path / "a.json")
    assert (back.up, back.metric, back.fixed) == ("+y", False, False)
    assert back.at(3).focus_distance_m == float("inf") and back.at(3).f_number is None
    for number in track.numbers:
        np.testing.assert_array_equal(back.at(number).camera.camera_from_world, frames[number].camera.camera_from_world)
    camera = moving(plain=True).at(2).camera
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(camera)))
    track = read_track(tmp_path / "camera.json")
    assert track.fixed and track.up == "-z"
    np.testing.assert_array_equal(track.at(100).camera.camera_from_world, camera.camera_from_world)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.chan", "0 1 2 3\n", "line 1: expected 8 numbers"),
        ("a.chan", "0 0 0 0 0 0 0 45\n0 0 0 0 0 0 0 45\n", "frame 0 comes twice"),
        ("a.chan", "\n", "holds no frame"),
        ("a.json", '{"format": "mrbokeh-camera-track", "version": 2}', "version 1"),
        ("a.json", '{"format": "mrbokeh-camera-track", "version": 1, "frames": [{"frame": 1}]}', "not a whole camera track"),
        ("transforms.json", '{"frames": [{"file_path": "a", "transform_matrix": [[1]]}]}', "a rotation and a shift"),
        ("a.jsonl", "{}\n", "whose protocol is OpenTrackIO"),
        ("a.usd", "", "what kind of camera track"),
    ],
)
def test_mistakes_end_in_one_sentence(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    refused(says, read_track, tmp_path / name, TrackOptions(size_px=SIZE_PX))
