"""Depth networks: real ONNX sessions of tiny networks whose answer is known, so that every step to and from them is proved."""

import json
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.depth.depth_map import DepthSettings, KnownDistance
from mrbokeh.depth.open_depth import IMAGENET_MEAN, IMAGENET_STD, NetworkInput, open_depth, predicted, read_network_input
from mrbokeh.images.color import srgb_to_linear
from tests.support.refusals import refused

onnx = pytest.importorskip("onnx", reason="the extra `train` brings onnx, which makes the test's networks")
SIZE = (32, 48)


def write_model(path: Path, nodes: list, shape: list, constants: dict[str, np.ndarray] | None = None) -> Path:
    from onnx import TensorProto, helper, numpy_helper

    seen = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
    given = helper.make_tensor_value_info("depth", TensorProto.FLOAT, None)
    kept = [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()]
    graph = helper.make_graph(nodes, "depth", [seen], [given], initializer=kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    onnx.save(model, str(path))
    return path


def channel_mean(path: Path, shape: list, axis: int = 1) -> Path:
    """Depth is the mean of the three normalised colours."""
    from onnx import helper

    return write_model(path, [helper.make_node("ReduceMean", ["image"], ["depth"], axes=[axis], keepdims=0)], shape)


def from_height(path: Path, shape: list) -> Path:
    """Depth is the row, 1 for the first: ones, added up downwards."""
    from onnx import helper

    nodes = [
        helper.make_node("ReduceMean", ["image"], ["grey"], axes=[1], keepdims=0),
        helper.make_node("Mul", ["grey", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "one"], ["ones"]),
        helper.make_node("CumSum", ["ones", "axis"], ["depth"]),
    ]
    constants: dict[str, np.ndarray] = {"zero": np.zeros(1, np.float32), "one": np.ones(1, np.float32), "axis": np.array(1, np.int64)}
    return write_model(path, nodes, shape, constants)


def photo() -> np.ndarray:
    """sRGB codes that 8 bits hold, as linear light."""
    codes = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)) / np.float32(255.0)
    return srgb_to_linear(codes.astype(np.float32))


def normalised() -> np.ndarray:
    codes = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)) / 255.0
    return (codes - np.array(IMAGENET_MEAN)) / np.array(IMAGENET_STD)


@pytest.mark.parametrize(("shape", "axis"), [([1, 3, 32, 48], 1), ([1, 32, 48, 3], 3), ([1, 3, "h", "w"], 1)])
def test_the_network_sees_imagenet_codes_in_its_layout(tmp_path: Path, shape: list, axis: int) -> None:
    """At the network's own size nothing is resized: what it gives is the mean of the normalised codes to the last digits."""
    model = channel_mean(tmp_path / "m.onnx", shape, axis)
    found = predicted(model, photo(), NetworkInput(short_side_px=32, multiple_px=16))
    np.testing.assert_allclose(found, normalised().mean(axis=2), atol=2e-6)


def test_a_sidecar_overrides_mean_std_and_order_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    from onnx import helper

    pick = [helper.make_node("Gather", ["image", "first"], ["depth"], axis=1)]
    model = write_model(tmp_path / "m.onnx", pick, [1, 3, 32, 48], {"first": np.array(0, np.int64)})
    (tmp_path / "m.json").write_text(json.dumps({"mean": [0.5, 0.5, 0.5], "std": [0.5, 0.25, 0.125], "channels": "BGR"}))
    wants = read_network_input(model)
    codes = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)) / 255.0
    np.testing.assert_allclose(predicted(model, photo(), wants), (codes[..., 2] - 0.5) / 0.5, atol=2e-6)
    model = channel_mean(tmp_path / "m.onnx", [1, 3, 32, 48])
    for values in ({"meen": 1}, {"fit": "crop"}, {"channels": "RGBA"}, {"std": [1, 1, 0]}):
        (tmp_path / "m.json").write_text(json.dumps(values))
        refused("expected", read_network_input, model)


def test_any_size_is_whole_multiples_and_padding_is_mirrored_and_cut_away(tmp_path: Path) -> None:
    """32x48 with a short side of 70 in steps of 14: 70 x 105 goes to 70 x 112 (105 / 14 = 7.5, to even 8)."""
    found = predicted(channel_mean(tmp_path / "m.onnx", [1, 3, None, None]), photo(), NetworkInput(short_side_px=70))
    assert found.shape == (70, 112)
    # A 48x32 picture in a square network of 48: 8 rows above and below are padding; its answer by rows starts at row 9.
    model = from_height(tmp_path / "m.onnx", [1, 3, 48, 48])
    found = predicted(model, photo(), NetworkInput(fit="pad"))
    np.testing.assert_array_equal(found, np.broadcast_to(np.arange(9, 41, dtype=np.float32)[:, None], SIZE))
    stretched = predicted(model, photo(), NetworkInput())
    np.testing.assert_array_equal(stretched[:, 0], np.arange(1, 49))


def test_inverse_depth_is_fitted_and_metric_depth_taken_as_it_is(tmp_path: Path) -> None:
    """Rows 1 to 32 become 1/4 to 1/0.5 dioptres in even steps."""
    model = from_height(tmp_path / "m.onnx", [1, 3, 32, 48])
    found = open_depth(model, photo(), DepthSettings(near_far_m=(0.5, 4.0), refined=False))
    np.testing.assert_allclose(1.0 / found.depth_m[:, 7], np.linspace(0.25, 2.0, 32), rtol=1e-5)
    assert "m.onnx" in found.note
    found = open_depth(model, photo(), DepthSettings(model_gives="metric", refined=False))
    np.testing.assert_allclose(found.depth_m[:, 0], np.arange(1, 33), rtol=1e-6)


def test_two_known_distances_fix_scale_and_offset(tmp_path: Path) -> None:
    """1 / depth = a row + b through 4 m at row index 3 and 1 m at row index 27: a = 0.75 / 24."""
    model = from_height(tmp_path / "m.onnx", [1, 3, 32, 48])
    settings = DepthSettings(known=(KnownDistance(5.0, 3.5, 4.0), KnownDistance(30.0, 27.5, 1.0)), refined=False)
    found = 1.0 / open_depth(model, photo(), settings).depth_m[:, 0]
    np.testing.assert_allclose(found, np.maximum(0.25 + (np.arange(32) - 3) * 0.75 / 24, 0.0), atol=1e-5)
    swapped = DepthSettings(known=(KnownDistance(5.0, 3.5, 1.0), KnownDistance(30.0, 27.5, 4.0)))
    one_depth = DepthSettings(known=(KnownDistance(5.0, 3.5, 1.0), KnownDistance(30.0, 3.5, 4.0)))
    outside = DepthSettings(known=(KnownDistance(5.0, 300.0, 1.0), KnownDistance(30.0, 3.5, 4.0)))
    for wrong, words in ((swapped, "swapped"), (one_depth, "different depths"), (outside, "outside")):
        refused(words, open_depth, model, photo(), wrong)


def test_what_is_no_depth_network_is_refused(tmp_path: Path) -> None:
    from onnx import helper

    refused("--disparity NEAR:FAR", open_depth, from_height(tmp_path / "a.onnx", [1, 3, 32, 48]), photo())
    two_planes = write_model(tmp_path / "b.onnx", [helper.make_node("Identity", ["image"], ["depth"])], [1, 3, 32, 48])
    refused("one plane of depth", predicted, two_planes, photo(), NetworkInput())
    four = channel_mean(tmp_path / "c.onnx", [1, 4, 32, 48])
    refused("one picture", predicted, four, photo(), NetworkInput())
    broken = write_model(
        tmp_path / "d.onnx",
        [helper.make_node("Log", ["image"], ["logs"]), helper.make_node("ReduceMean", ["logs"], ["depth"], axes=[1], keepdims=0)],
        [1, 3, 32, 48],
    )
    refused("NaN", predicted, broken, photo(), NetworkInput())
