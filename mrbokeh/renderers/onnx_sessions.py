"""ONNX files opened on the best processor there is.

Spinning is off: threads that wait in a busy loop take the cores that rendering, or another network, needs.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrbokeh.system.errors import InputError, require_file

if TYPE_CHECKING:
    import onnxruntime

PROVIDERS = {
    "tensorrt": "TensorrtExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "directml": "DmlExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}
CPU = "CPUExecutionProvider"
_PACKAGES = {
    "tensorrt": "onnxruntime-gpu and TensorRT",
    "cuda": "onnxruntime-gpu",
    "directml": "onnxruntime-directml (Windows)",
    "coreml": "onnxruntime on a Mac",
    "openvino": "onnxruntime-openvino",
}
# Apple's neural engine computes in 16 bits; CPU and GPU keep the network's 32. NeuralNetwork, the older default, lacks most operators.
_OPTIONS = {"CoreMLExecutionProvider": {"ModelFormat": "MLProgram", "MLComputeUnits": "CPUAndGPU"}}
# As onnxruntime 1.20 to 1.31 say it: core/graph/model.cc and model_load_utils.h.
_NEWER_IR = re.compile(r"IR version: (\d+), max supported IR version: (\d+)")
_NEWER_OPSET = re.compile(r"Opset (\d+) is under development.*till opset (\d+)", re.DOTALL)


def open_session(path: Path, threads: int = 0, providers: Sequence[str] | None = None) -> "onnxruntime.InferenceSession":
    """Open the network at `path`, ready to run.

    threads: of the CPU, 0 takes all cores. providers: names out of PROVIDERS and "cpu", best first, all of which must be there; None takes
    those that are there. What none of them can compute is left to the CPU.
    Raises InputError for a file that is no network and for a provider that is not installed.
    """
    import onnxruntime

    require_file(path, "a network", f": make one with `mrbokeh train export RUN --out {path}`")
    chosen = _chosen(providers, onnxruntime.get_available_providers())
    try:
        options = [_OPTIONS.get(each, {}) for each in chosen]
        return onnxruntime.InferenceSession(str(path), _options(threads), providers=chosen, provider_options=options)
    except Exception as error:  # onnxruntime has no common base class for "this is not a model"
        raise InputError(_unopened(path, str(error))) from None


def provider_of(session: "onnxruntime.InferenceSession") -> str:
    """Return the short name of the provider that comes first in an open session: "cpu" or one of PROVIDERS.

    A provider that is installed but finds no device is dropped by ONNX Runtime while the session opens, and is not named here.
    """
    first = session.get_providers()[0]
    return next((name for name, full in PROVIDERS.items() if full == first), "cpu")


def _unopened(path: Path, reason: str) -> str:
    """Return why a file was not opened: in ONNX Runtime's words, unless the file is newer than that."""
    import onnxruntime

    for newer, what in ((_NEWER_IR, "IR version"), (_NEWER_OPSET, "opset")):
        if found := newer.search(reason):
            return (
                f"{path} is of ONNX {what} {found[1]}, but ONNX Runtime {onnxruntime.__version__} reads up to {found[2]}: install a newer "
                f"onnxruntime, or export it again, by `mrbokeh train export` or with a lower opset_version (and ir_version) elsewhere"
            )
    return f"{path} cannot be opened as an ONNX network: {reason[:200]}"


def _chosen(wanted: Sequence[str] | None, available: Sequence[str]) -> list[Any]:
    if wanted is None:
        return [full for full in PROVIDERS.values() if full in available] + [CPU]
    full_names = [CPU if name == "cpu" else PROVIDERS.get(name, "") for name in wanted]
    for name, full in zip(wanted, full_names, strict=True):
        if full not in available:
            raise InputError(_missing(name, available))
    return full_names if CPU in full_names else [*full_names, CPU]


def _missing(name: str, available: Sequence[str]) -> str:
    there = [short for short, full in PROVIDERS.items() if full in available] + ["cpu"]
    if name not in PROVIDERS:
        return f"expected providers out of {[*PROVIDERS, 'cpu']}, got {name!r}: use one of those that are here, {there}"
    return f"the provider {name!r} is not in this ONNX Runtime: install {_PACKAGES[name]}, or use one of those that are here, {there}"


def _options(threads: int) -> "onnxruntime.SessionOptions":
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    # Sizes change from call to call, and a pattern belongs to one size; DirectML takes none.
    options.enable_mem_pattern = False
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options
