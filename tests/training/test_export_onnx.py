"""Export: ONNX Runtime computes what PyTorch does, the file says which lens it is, and nothing is written when it would lie."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import field_positions
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers import onnx_network
from mrbokeh.renderers.onnx_network import METADATA_KEY, OnnxNetwork
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.made_networks import jittered
from tests.support.refusals import refused
from training.cli import app
from training.export import onnx_export
from training.export.onnx_export import LARGEST_DIFFERENCE, export_network, largest_difference, picture_for_parity
from training.fitting.run_folder import RunFacts, build_network, save_network, write_facts
from training.fitting.settings import TrainSettings, better_settings, demo_settings, write_settings
from training.networks.network import BlurNetwork
from training.networks.network_settings import NetworkSettings

LENS = Lens(35.0, 2.8, 1.25, 23.5, Aperture.blades(6))
FACTS = RunFacts(LENS, 60, 40, 6.5, 12.0, ("attic/view_0", "attic/view_1"), ("attic/view_2",), "0123abc", (1.4, 5.6), (24.0, 70.0))
FORMS = {
    "published": NetworkSettings(tile_px=24, overlap_px=8),
    "published, one tile": NetworkSettings(tile_px=0, overlap_px=0, width=2, mixing="tile"),
    "gated": demo_settings().network,
    "gated, tiles, unsigned": replace(demo_settings().network, tile_px=32, overlap_px=6, signed_coc=False),
    "gated, place": better_settings().network,
}
FORMS["published, 3x3, tiles, all inputs"] = replace(FORMS["published"], kernels="3x3", field_position=True, lens_inputs=True, headroom=1.5)
FORMS["published, 3x3, all inputs"] = replace(FORMS["published, 3x3, tiles, all inputs"], tile_px=0, overlap_px=0)


def _network(settings: NetworkSettings, seed: int = 0) -> BlurNetwork:
    """Parity is of the whole computation, so weights are away from their start."""
    return jittered(build_network(TrainSettings(network=settings), FACTS), 0.05, seed).eval()


FAST_FORMS = ("gated, tiles, unsigned", "published, 3x3, all inputs")
"""Between them both networks, with tiles and at any size, and all inputs; the others take as long each and add no operator."""


@pytest.fixture(
    scope="module",
    params=[pytest.param(form, id=name, marks=() if name in FAST_FORMS else pytest.mark.slow) for name, form in FORMS.items()],
)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[BlurNetwork, NetworkSettings, Path]:
    path = tmp_path_factory.mktemp("onnx") / "lens.onnx"
    network = _network(request.param)
    export_network(network, request.param, FACTS, path)
    return network, request.param, path


def test_parity_and_what_the_file_says_of_itself(exported: tuple[BlurNetwork, NetworkSettings, Path]) -> None:
    """The product promises 1e-4."""
    network, settings, path = exported
    assert largest_difference(network, OnnxNetwork(path)) < 1e-4
    onnx.checker.check_model(str(path))
    # Other weights than those exported are far off, so the check can fail.
    assert largest_difference(_network(settings, seed=1), OnnxNetwork(path)) > 1e-3
    _, settings, path = exported
    facts = OnnxNetwork(path).facts
    assert (facts.width_px, facts.height_px, facts.largest_coc_px, facts.radiance_scale) == (60, 40, 6.5, 12.0)
    assert (facts.signed_coc, facts.tiled) == (settings.signed_coc, settings.tile_px > 0)
    assert facts.linear_in_radiance == (settings.form == "gated")
    assert (facts.trained_on, facts.commit) == (FACTS.trained_on, "0123abc")
    assert replace(facts.lens, aperture=FACTS.lens.aperture) == FACTS.lens
    assert facts.field_position == settings.field_position and facts.lens_inputs == settings.lens_inputs
    assert (facts.f_numbers, facts.focal_lengths_mm) == (((1.4, 5.6), (24.0, 70.0)) if settings.lens_inputs else (None, None))
    assert np.allclose(facts.lens.aperture.outlines[0], FACTS.lens.aperture.outlines[0])
    _, settings, path = exported
    further = ["place"] * settings.field_position + ["lens"] * settings.lens_inputs
    assert [each.name for each in onnx.load(path).graph.input] == ["rgb", "coc_px", *further]


def test_size_is_free_without_tiles_only(exported: tuple[BlurNetwork, NetworkSettings, Path]) -> None:
    network, settings, path = exported
    rgb, coc_px = np.full((33, 47, 3), 0.3, np.float32), np.full((33, 47), 4.0, np.float32)
    if settings.tile_px:
        with pytest.raises(InputError, match="60x40 px, but came 47x33 px"):
            OnnxNetwork(path).blur(rgb, coc_px)
        return
    place = torch.from_numpy(field_positions((33, 47)).transpose(2, 0, 1).copy())[None]
    planes = torch.from_numpy(rgb).permute(2, 0, 1)[None], torch.from_numpy(coc_px)[None, None]
    expected = network(*planes, place, torch.tensor([[2.8, 35.0]]))[0].permute(1, 2, 0)
    assert np.allclose(OnnxNetwork(path).blur(rgb, coc_px), expected.detach().numpy(), atol=1e-4)  # whole frame, lens of the facts


def test_files_from_before_place_and_lens_still_load(exported: tuple[BlurNetwork, NetworkSettings, Path], tmp_path: Path) -> None:
    """Their facts lack the three newer names; all else is as it was."""
    _, settings, path = exported
    if settings.input_channels > 4:
        return
    old = onnx.load(path)
    facts = json.loads(old.metadata_props[0].value)
    for name in ("field_position", "f_numbers", "focal_lengths_mm"):
        del facts[name]
    old.metadata_props[0].value = json.dumps(facts)
    onnx.save(old, tmp_path / "old.onnx")
    rgb, coc_px = (each[0].permute(1, 2, 0).numpy().copy() for each in picture_for_parity(OnnxNetwork(path).facts))
    assert np.array_equal(OnnxNetwork(tmp_path / "old.onnx").blur(rgb, coc_px[..., 0]), OnnxNetwork(path).blur(rgb, coc_px[..., 0]))


def test_a_command_writes_what_computes_the_same_and_nothing_else(
    exported: tuple[BlurNetwork, NetworkSettings, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it writes of the run's network was written above, and is compared with the run's network again."""
    (network, settings, path), run, out = exported, tmp_path / "run", tmp_path / "lens.onnx"
    run.mkdir()
    write_settings(run, TrainSettings(network=settings))
    write_facts(run, FACTS)
    refused("no finished network", printed_by, app, "export", run, "--out", out)
    save_network(run, network)
    monkeypatch.setattr(onnx_export, "_write", lambda _network, _facts, out: shutil.copyfile(path, out))
    sizes = "60x40" if settings.tile_px else "any size"
    assert sizes in printed_by(app, "export", run, "--out", out)
    assert sizes in out.with_suffix(".md").read_text(encoding="utf-8")
    refused("--overwrite", printed_by, app, "export", run, "--out", out)
    monkeypatch.setattr(onnx_export, "largest_difference", lambda *_: 2 * LARGEST_DIFFERENCE)
    refused("nothing was written", printed_by, app, "export", run, "--out", tmp_path / "other.onnx")
    assert not list(tmp_path.glob("*other*"))


def test_foreign_and_damaged_files_are_refused(tmp_path: Path, exported: tuple[BlurNetwork, NetworkSettings, Path]) -> None:
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(exported[2].read_bytes()[:100])
    refused("cannot be opened as an ONNX network", OnnxNetwork, damaged)
    refused("there is no such file", OnnxNetwork, tmp_path / "absent.onnx")
    foreign = onnx.load(exported[2])
    del foreign.metadata_props[:]
    onnx.save(foreign, tmp_path / "foreign.onnx")
    refused("does not say which lens", OnnxNetwork, tmp_path / "foreign.onnx")
    foreign.metadata_props.add(key=METADATA_KEY, value=json.dumps({"format": onnx_network.FORMAT, "version": 99}))
    onnx.save(foreign, tmp_path / "newer.onnx")
    refused("export it again", OnnxNetwork, tmp_path / "newer.onnx")
