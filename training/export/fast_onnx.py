"""Export of a trained network as a fast ONNX file, written only if its loss against the trained network stays within a budget in dB."""

import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor

from mrbokeh.optics.camera import field_positions
from mrbokeh.renderers.onnx_network import METADATA_KEY, NetworkFacts, OnnxNetwork
from mrbokeh.renderers.onnx_sessions import open_session
from mrbokeh.system.atomic_files import atomic_path, write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from training.data.batches import stack_pairs
from training.data.dataset import PairSet
from training.data.pairs import WHERE_TRUTH_IS_KNOWN
from training.data.training_data import training_data
from training.export.onnx_export import export_network, largest_difference, network_facts_of, record_path
from training.export.plans import Plan, model_of, plans
from training.fitting.run_folder import RunFacts, load_run
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings

ASSUMED_PSNR_DB = 42.0  # of a trained network against the truth, where no truth is given (Mandl et al. 2024, Table 1)
SLICES, LARGEST_SIDE_PX = 4, 448
TIMED_SIZE_PX = (360, 640)
ROUNDS = 3


@dataclass(frozen=True)
class LossSample:
    """One picture: inputs of the graph by name, the trained network's result, and the truth and its weight if they are known.

    All (1, C, H, W); lens is (1, 2).
    """

    inputs: dict[str, Tensor]
    trained: Tensor
    truth: Tensor | None = None
    weight: Tensor | None = None


def loss_db(session: onnxruntime.InferenceSession, samples: Sequence[LossSample]) -> float:
    """Return the mean loss over pictures of the PSNR (linear radiance clipped to [0, 1]) against the truth.

    Without a truth it is the loss that the difference to the trained network would cause at ASSUMED_PSNR_DB:
    10 lg(1 + error / error of that network).
    """
    losses = []
    for sample in samples:
        names = {each.name for each in session.get_inputs()}
        feed = {name: values.numpy() for name, values in sample.inputs.items() if name in names}
        fast = torch.from_numpy(session.run(["blurred"], feed)[0])
        if sample.truth is None:
            losses.append(10.0 * math.log10(1.0 + _error(fast, sample.trained, None) * 10.0 ** (ASSUMED_PSNR_DB / 10.0)))
        else:
            errors = [max(_error(each, sample.truth, sample.weight), 1e-12) for each in (fast, sample.trained)]
            losses.append(10.0 * math.log10(errors[0] / errors[1]))
    return float(np.mean(losses))


def made_up_sample(network: BlurNetwork, facts: NetworkFacts, size_px: tuple[int, int] = (216, 384)) -> LossSample:
    """Make up a picture with texture of all scales, highlights, and every circle of confusion, in ramps and in steps."""
    height, width = (facts.height_px, facts.width_px) if facts.tiled else size_px
    rng = np.random.default_rng(0)
    rgb = np.zeros((3, height, width), np.float32)
    for scale_px in (1, 4, 16, 64):
        coarse = rng.random((3, -(-height // scale_px), -(-width // scale_px)), dtype=np.float32)
        rgb += 0.25 * np.kron(coarse, np.ones((1, scale_px, scale_px), np.float32))[:, :height, :width]
    lights = rng.integers(0, (height, width), size=(12, 2))
    rgb[:, lights[:, 0], lights[:, 1]] = facts.radiance_scale
    ramp = np.broadcast_to(np.linspace(-1.0, 1.0, width, dtype=np.float32), (height, width)).copy()
    ramp[height // 4 : height // 2] = np.repeat(rng.uniform(-1.0, 1.0, -(-width // 24)), 24)[:width]
    inputs = {"rgb": rgb[None], "coc_px": (facts.largest_coc_px * ramp)[None, None]}
    inputs["place"] = field_positions((height, width)).transpose(2, 0, 1)[None]
    inputs["lens"] = np.array([[facts.lens.f_number, facts.lens.focal_length_mm]], np.float32)
    return _sample({name: torch.from_numpy(np.ascontiguousarray(values, np.float32)) for name, values in inputs.items()}, network)


def loss_samples(scenes: Sequence[Path], network: BlurNetwork, facts: NetworkFacts) -> list[LossSample]:
    """Return some slices that the network was not trained on, or any if it was trained on all; large pictures are cropped to the middle."""
    from training.data.stacks import Seen, stack_name

    stacks = training_data(scenes).stacks
    seen = Seen(facts.trained_on, facts.held_out_slices)
    slices = {stack_name(stack): sorted(seen.unseen_slices(stack)) for stack in stacks}
    pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0, slices=slices if any(slices.values()) else None)
    samples = []
    for index in np.unique(np.linspace(0, len(pairs) - 1, SLICES).round()):
        pair = pairs[int(index)]
        if not facts.tiled:
            pair = pair.cut(*(_middle(length) for length in pair.coc_px.shape))
        batch = stack_pairs([pair])
        inputs = {"rgb": batch.rgb, "coc_px": batch.coc_px, "place": batch.place, "lens": batch.lens}
        samples.append(_sample(inputs, network, batch.target, batch.weight))
    return samples


@torch.no_grad()
def _sample(inputs: dict[str, Tensor], network: BlurNetwork, truth: Tensor | None = None, weight: Tensor | None = None) -> LossSample:
    return LossSample(inputs, network(**inputs), truth, weight)


def _error(a: Tensor, b: Tensor, weight: Tensor | None) -> float:
    squares = (a.clamp(0, 1) - b.clamp(0, 1)).square()
    return float(squares.mean()) if weight is None else float((weight * squares).sum() / (3.0 * weight.sum()).clamp(min=1e-6))


def _middle(length_px: int) -> slice:
    start = max(0, (length_px - LARGEST_SIDE_PX) // 2)
    return slice(start, min(length_px, start + LARGEST_SIDE_PX))


@dataclass(frozen=True)
class FastExported:
    """The exported network.

    loss_db: as measured. naive_ms, fast_ms: of a picture with every circle of confusion everywhere, the lowest of some alternating
    rounds. difference: the largest one to PyTorch.
    """

    facts: NetworkFacts
    plan: Plan
    loss_db: float
    naive_ms: float
    fast_ms: float
    difference: float


def export_fast_run(run_folder: Path, path: Path, max_psnr_loss_db: float = 0.2, scenes: Sequence[Path] = ()) -> FastExported:
    """Export the finished network of a run to `path`. scenes: focal stacks with the truth; without them a made-up picture decides.

    Raises InputError, and leaves no file, if no plan keeps within the budget.
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
    samples = loss_samples(scenes, network, network_facts) if scenes else [made_up_sample(network, network_facts)]
    with atomic_path(path) as temporary, tempfile.TemporaryDirectory() as folder:
        plan, loss = _boldest(network, candidates, network_facts, temporary, lambda session: loss_db(session, samples), max_psnr_loss_db)
        export_network(network, settings, facts, Path(folder) / "naive.onnx")
        naive_ms, fast_ms = _timed([Path(folder) / "naive.onnx", temporary], made_up_inputs(network_facts, samples[0]))
        exported = OnnxNetwork(temporary)
        result = FastExported(
            facts=exported.facts,
            plan=plan,
            loss_db=loss,
            naive_ms=naive_ms,
            fast_ms=fast_ms,
            difference=largest_difference(network, exported),
        )
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
    """Write the first plan within the budget to `path` and return it with its loss."""
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


def made_up_inputs(facts: NetworkFacts, sample: LossSample) -> dict[str, np.ndarray]:
    """Return the inputs to be timed: the sample's picture, repeated to the standard size for timing if the size is free.

    Every circle of confusion is everywhere, in no order, so that nothing can be skipped: the slowest picture there is.
    """
    height, width = sample.inputs["rgb"].shape[2:] if facts.tiled else TIMED_SIZE_PX
    inputs = {}
    for name, values in sample.inputs.items():
        array = values.numpy()
        if array.ndim == 4:
            repeats = (1, 1, -(-height // array.shape[2]), -(-width // array.shape[3]))
            array = np.ascontiguousarray(np.tile(array, repeats)[:, :, :height, :width])
        inputs[name] = array
    fraction = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 1, height, width)).astype(np.float32)
    return inputs | {"coc_px": facts.largest_coc_px * fraction}


def _timed(paths: Sequence[Path], inputs: dict[str, np.ndarray]) -> list[float]:
    """Return the milliseconds of each network, the lowest of some alternating rounds."""
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
