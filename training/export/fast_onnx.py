"""Export of a trained network as a fast ONNX file, written only if its loss against the trained network stays within a budget in dB.

Plans are tried from the boldest one to one that changes nothing.
"""

import json
import math
import tempfile
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import ModelProto
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
from training.export.gated_graph import gated_model
from training.export.gated_groups import cost, reach_px, shared
from training.export.gated_weights import thinned, weights_of
from training.export.onnx_export import export_network, largest_difference, network_facts_of, record_path
from training.export.published_graph import BlockPlan, PublishedGraph, blocks_of, kernels_of, piece_px, separable_kernels
from training.fitting.run_folder import RunFacts, load_run
from training.networks.gated_network import GatedTiles
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings
from training.networks.published_network import PublishedTiles, ResidualBlock

FACTORS = (4, 2, 1)
LEAST_PIXELS = (3.0, 4.0, 5.0, 6.5, 8.5, 11.0, 15.0, 20.0, 27.0, float("inf"))
SPACINGS = (0.4, 0.3, 0.2, 0.16, 0.14, 0.12, 0.1, 0.05, 0.0)  # of bins, over their diameter
SMALL_ERROR = 0.02  # of a separable kernel, norm over norm
_MATRIX_OVER_CONVOLUTION = 0.5  # measured on Zen 5: multiplications a second of MatMul with its copies, over those of a blocked Conv
ASSUMED_PSNR_DB = 42.0  # of a trained network against the truth, where no truth is given (Mandl et al. 2024, Table 1)
SLICES, LARGEST_SIDE_PX = 4, 448
TIMED_SIZE_PX = (360, 640)
ROUNDS = 3


@dataclass(frozen=True)
class Plan:
    """A plan. least_pixels: the least width of a kernel in coarse pixels. factors, ranks: for n = 1, 2, ...; rank None is not separable.

    spacing: of the bins of the gated form, see `gated_weights.thinned`; bins: how many that leaves, 0 in the published form.
    reach_px: how far from a pixel the graph looks.
    """

    least_pixels: float
    factors: tuple[int, ...]
    ranks: tuple[int | None, ...]
    reach_px: int
    spacing: float = 0.0
    bins: int = 0

    def to_json(self) -> dict[str, Any]:
        return {"factors": list(self.factors), "ranks": list(self.ranks), "spacing": self.spacing, "bins": self.bins}

    def words(self) -> str:
        """Describe the plan in one line."""
        shares = [f"{self.factors.count(factor)} at 1/{factor}" for factor in sorted(set(self.factors))]
        ranks = sorted(rank for rank in self.ranks if rank is not None)
        low_rank = f"{len(ranks)} separable of rank {ranks[0]} to {ranks[-1]}" if ranks else "none separable"
        return f"kernel sizes by resolution: {', '.join(shares)}; {f'{self.bins} bins' if self.bins else low_rank}"


def plans(network: BlurNetwork) -> Sequence[Plan]:
    """Return the plans, boldest first. Large kernels move to coarse pixels while they stay at least `least_pixels` of them wide."""
    if isinstance(network.tiles, GatedTiles) and network.grid is not None:
        raise InputError("a fast export of the gated form needs a network without tiles: train with `--set network.tile_px=0`")
    if isinstance(network.tiles, GatedTiles):
        return _gated_plans(network.tiles)
    if isinstance(network.tiles, PublishedTiles):
        return [_published_plan(network, network.tiles, least) for least in LEAST_PIXELS]
    raise InputError("a fast export is there for the published and the gated form only: export without --fast")


def _gated_plans(tiles: GatedTiles) -> list[Plan]:
    """Return every resolution with every number of bins, by cost; of equivalent ones the first."""
    found: dict[Hashable, tuple[float, Plan]] = {}
    sizes, whole = range(1, len(tiles.kernels) + 1), weights_of(tiles)
    for spacing in SPACINGS:
        weights = thinned(whole, spacing)
        for least in LEAST_PIXELS:
            factors = _factors(sizes, least)
            plan = Plan(
                least_pixels=least,
                factors=factors,
                ranks=(None,) * len(factors),
                reach_px=reach_px(weights, factors),
                spacing=spacing,
                bins=len(weights.knots_px),
            )
            found.setdefault((tuple(weights.knots_px), *shared(weights, factors)), (cost(weights, factors), plan))
    return [plan for _, plan in sorted(found.values(), key=lambda each: each[0])]


def _published_plan(network: BlurNetwork, tiles: PublishedTiles, least: float) -> Plan:
    factors = _factors([block.radius for block in blocks_of(tiles)], least)
    ranks = tuple(_rank(block) if factor == 1 and least < np.inf else None for block, factor in zip(blocks_of(tiles), factors, strict=True))
    return Plan(least, factors, ranks, network.reach_px + sum(4 * factor for factor in factors if factor > 1))


def _factors(radii: Sequence[int], least_pixels: float) -> tuple[int, ...]:
    return tuple(next((factor for factor in FACTORS if (2 * n + 1) / factor >= least_pixels), 1) for n in radii)


def model_of(network: BlurNetwork, plan: Plan) -> ModelProto:
    if isinstance(network.tiles, GatedTiles):
        return gated_model(network, thinned(weights_of(network.tiles), plan.spacing), plan.factors)
    return PublishedGraph(network, [BlockPlan(*each) for each in zip(plan.factors, plan.ranks, strict=True)]).model()


def _rank(block: ResidualBlock) -> int | None:
    """Return the smallest rank with little error in both convolutions of a block, if it takes less time than they do."""
    n = block.radius
    worth = int(_MATRIX_OVER_CONVOLUTION * (2 * n + 1) ** 2 / (2 * (piece_px(n) + 2 * n)))
    both = [kernels_of(each, each.out_channels)[0] for each in (block.first, block.second)]
    for rank in range(1, worth + 1):
        if all(separable_kernels(kernels, rank).relative_error <= SMALL_ERROR for kernels in both):
            return rank
    return None


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
