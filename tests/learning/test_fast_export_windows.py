"""Windows of the fast gated graph: nothing is computed where no light of a group goes, and nothing changes by that."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.scenes.made_networks import GATED, PARITY, blurred, coarser_model, pictures, session_of, twin, untrained
from training.export import gated_groups


def _two_cards() -> dict[str, torch.Tensor]:
    """In focus, with a near card at the border and a far one inside; 170 and 250 are no multiples of 4."""
    inputs = pictures((170, 250))
    coc_px = torch.zeros_like(inputs["coc_px"])
    coc_px[..., :17, 100:] = -10.5
    coc_px[..., 40:57, 31:52] = 8.7
    return inputs | {"coc_px": coc_px}


def _convolved_pixels(path: str) -> int:
    """Pixels that the convolutions of a profile gave, over all their channels, without the one around the focus, which is the largest."""
    events = [each for each in json.loads(Path(path).read_text()) if each["name"].endswith("kernel_time")]
    shapes = [each["args"]["output_type_shape"][0]["float"] for each in events if each["args"].get("op_name") == "Conv"]
    return sum(sorted(int(np.prod(shape)) for shape in shapes)[:-1])


@pytest.mark.parametrize("changes", [{}, {"field_bases": 2, "field_position": True}], ids=["demo", "field"])
def test_what_is_computed_in_windows_is_the_network(changes: dict) -> None:
    network = untrained(replace(GATED, **changes))
    got = blurred(session_of(coarser_model(network)), _two_cards())
    assert np.abs(got - twin(network, _two_cards())).max() < PARITY


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_windows_change_nothing_and_save_most(factor: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin has windows as large as the picture. The cards cover 7 % of it, and what they reach less than a quarter."""
    network, results, pixels = untrained(GATED), [], []
    for reach in (None, 1000):
        if reach is not None:
            monkeypatch.setattr(gated_groups, "reach_of", lambda *_: 1000)
        session = session_of(coarser_model(network, factor), tmp_path / str(reach))
        results.append(blurred(session, _two_cards()))
        pixels.append(_convolved_pixels(session.end_profiling()))
    np.testing.assert_allclose(results[0], results[1], atol=2e-5)
    assert pixels[0] < 0.25 * pixels[1]
