"""A trained network as a fast ONNX file, written only where it loses less than it may."""

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from mrbokeh.renderers.network.onnx_network import METADATA_KEY, NetworkFacts, OnnxNetwork
from mrbokeh.renderers.network.onnx_sessions import open_session
from mrbokeh.system.atomic_files import atomic_path, write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from training.export_onnx import export_network, largest_difference, network_facts_of, record_path
from training.fast_export.measured_loss import Look, looks_at, loss_db, made_up_look
from training.fast_export.plans import Plan, model_of, plans
from training.network import BlurNetwork
from training.network_settings import NetworkSettings
from training.run_folder import RunFacts, load_run

TIMED_SIZE_PX = (360, 640)
ROUNDS = 3


@dataclass(frozen=True)
class FastExported:
    """loss_db: measured (see `training.fast_export.measured_loss`); naive_ms, fast_ms: of a picture with every circle of confusion
    everywhere, the lowest of some rounds in turns; difference: largest one to PyTorch."""

    facts: NetworkFacts
    plan: Plan
    loss_db: float
    naive_ms: float
    fast_ms: float
    difference: float


def export_fast_run(run_folder: Path, path: Path, max_psnr_loss_db: float = 0.2, scenes: Sequence[Path] = ()) -> FastExported:
    """The finished network of a run as `path`. scenes: focal stacks with the truth; without them a made-up picture decides.

    Raises InputError, and leaves no file, where no plan keeps within the budget.
    """
    network, settings, facts = load_run(run_folder)
    return export_fast_network(network, settings.network, facts, path, max_psnr_loss_db=max_psnr_loss_db, scenes=scenes)


def export_fast_network(
    network: BlurNetwork,
    settings: NetworkSettings,
    facts: RunFacts,
    path: Path,
    *,
    max_psnr_loss_db: float = 0.2,
    scenes: Sequence[Path] = (),
) -> FastExported:
    network_facts = network_facts_of(network, settings, facts)
    candidates = plans(network)
    looks = looks_at(scenes, network, network_facts) if scenes else [made_up_look(network, network_facts)]
    with atomic_path(path) as temporary, tempfile.TemporaryDirectory() as folder:
        plan, loss = _boldest(network, candidates, network_facts, temporary, lambda session: loss_db(session, looks), max_psnr_loss_db)
        export_network(network, settings, facts, Path(folder) / "naive.onnx")
        naive_ms, fast_ms = _timed([Path(folder) / "naive.onnx", temporary], made_up_inputs(network_facts, looks[0]))
        exported = OnnxNetwork(temporary)
        result = FastExported(exported.facts, plan, loss, naive_ms, fast_ms, largest_difference(network, exported))
    write_json(record_path(path), {**_record(result, max_psnr_loss_db, scenes), **json.loads(result.facts.to_json())})
    return result


def _boldest(
    network: BlurNetwork,
    candidates: Sequence[Plan],
    facts: NetworkFacts,
    path: Path,
    loss: Callable[[onnxruntime.InferenceSession], float],
    max_loss_db: float,
) -> tuple[Plan, float]:
    """The first plan within the budget, written to `path`, and what it loses."""
    losses = []
    for plan in track(candidates, "plans tried"):
        write_model(network, plan, facts, path)
        losses.append(loss(open_session(path)))
        if losses[-1] <= max_loss_db:
            return plan, losses[-1]
    raise InputError(
        f"no fast form of this network loses at most {max_loss_db:g} dB, the best one {min(losses):.3g} dB: "
        f"allow more with --max-psnr-loss, or export without --fast"
    )


def write_model(network: BlurNetwork, plan: Plan, facts: NetworkFacts, path: Path) -> None:
    model = model_of(network, plan)
    onnx.helper.set_model_props(model, {METADATA_KEY: replace(facts, reach_px=max(facts.reach_px, plan.reach_px)).to_json()})
    path.write_bytes(model.SerializeToString())


def made_up_inputs(facts: NetworkFacts, look: Look) -> dict[str, np.ndarray]:
    """What is timed: the look's picture, repeated to the size at which networks are timed where the size is free.

    Every circle of confusion is everywhere, in no order, so that nothing can be left out: the slowest picture there is.
    """
    height, width = look.inputs["rgb"].shape[2:] if facts.tiled else TIMED_SIZE_PX
    inputs = {}
    for name, values in look.inputs.items():
        array = values.numpy()
        if array.ndim == 4:
            repeats = (1, 1, -(-height // array.shape[2]), -(-width // array.shape[3]))
            array = np.ascontiguousarray(np.tile(array, repeats)[:, :, :height, :width])
        inputs[name] = array
    fraction = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 1, height, width)).astype(np.float32)
    return inputs | {"coc_px": facts.largest_coc_px * fraction}


def _timed(paths: Sequence[Path], inputs: dict[str, np.ndarray]) -> list[float]:
    """Milliseconds of each network, the lowest of some rounds in which they take turns."""
    sessions = [open_session(path) for path in paths]
    best = [float("inf")] * len(paths)
    for round_number in range(ROUNDS + 1):
        for i, session in enumerate(sessions):
            feed = {each.name: inputs[each.name] for each in session.get_inputs()}
            started_s = time.perf_counter()
            session.run(["blurred"], feed)
            if round_number:  # the first one allocates
                best[i] = min(best[i], 1e3 * (time.perf_counter() - started_s))
    return best


def _record(result: FastExported, max_psnr_loss_db: float, scenes: Sequence[Path]) -> dict[str, object]:
    values = {name: value for name, value in asdict(result).items() if name not in ("facts", "plan")}
    return {"fast": True, "max_psnr_loss_db": max_psnr_loss_db, "measured_against_truth": bool(scenes), **values, **result.plan.to_json()}
