"""Opening a network on the best provider there is."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper

from mrbokeh.renderers.onnx_sessions import CPU, PROVIDERS, _chosen, open_session, provider_of
from mrbokeh.system.errors import InputError

ALL = [*PROVIDERS.values(), CPU]


@pytest.fixture
def doubling(tmp_path: Path) -> Path:
    """A network that adds its input to itself."""
    sizes = [helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [2]) for name in ("x", "y")]
    graph = helper.make_graph([helper.make_node("Add", ["x", "x"], ["y"])], "doubling", sizes[:1], sizes[1:])
    path = tmp_path / "doubling.onnx"
    path.write_bytes(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9).SerializeToString())
    return path


def test_it_runs_on_the_cpu_and_what_is_not_there_is_said_by_name(doubling: Path) -> None:
    session = open_session(doubling, threads=1, providers=["cpu"])
    assert provider_of(session) == "cpu"
    np.testing.assert_array_equal(session.run(["y"], {"x": np.array([1.0, 2.0], np.float32)})[0], [2.0, 4.0])
    missing = next(name for name, full in PROVIDERS.items() if full not in onnxruntime.get_available_providers())
    with pytest.raises(InputError, match=f"'{missing}' is not in this ONNX Runtime: install"):
        open_session(doubling, providers=[missing])
    with pytest.raises(InputError, match="got 'tpu'"):
        open_session(doubling, providers=["tpu"])


def test_a_wish_is_kept_else_the_fastest_comes_first_and_the_cpu_last() -> None:
    assert _chosen(None, ALL) == ALL
    assert _chosen(None, [CPU, "AzureExecutionProvider", "CUDAExecutionProvider"]) == ["CUDAExecutionProvider", CPU]
    assert _chosen(None, [CPU, "CoreMLExecutionProvider"]) == ["CoreMLExecutionProvider", CPU]
    assert _chosen(["openvino"], ALL) == ["OpenVINOExecutionProvider", CPU]
    assert _chosen(["cpu"], ALL) == [CPU]


def test_no_file_and_no_network_are_said_plainly(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        open_session(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(InputError, match="cannot be opened as an ONNX network"):
        open_session(tmp_path / "text.onnx")
