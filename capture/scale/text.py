"""What was found about scale and focus, in lines for people."""

from collections.abc import Iterator

import numpy as np

from capture.scale.answer import ScaleAnswer
from capture.scale.metric_scale import ScaledScene


def scale_lines(scaled: ScaledScene) -> Iterator[str]:
    result = scaled.result
    for each in result.answers:
        difference = result.disagreement.get(each.method)
        compared = "used" if difference is None else f"{100 * difference:+.2f} % from the one used"
        yield (f"{each.method}: {each.metres_per_unit:.6g} metres per unit +- {100 * each.uncertainty:.3f} % ({compared}; {_basis(each)})")
    for method, why in result.missing.items():
        yield f"{method}: no answer, for {why}"
    for method in result.contradictions:
        yield f"warning: {method} contradicts {result.used.method}: measure the print or the distance again, or check the focus distances"
    for name, found in scaled.calibrated.items():
        fit = found.fit
        yield (
            f"{name}: focus from {1 / fit.dioptres.max():.3f} to {1 / max(fit.dioptres.min(), 1e-6):.3f} m "
            f"+- {float(np.median(fit.sigma_dioptre)):.4f} dioptres, blur {np.median(fit.px_per_dioptre):.2f} px per dioptre"
        )
    for name, why in scaled.uncalibrated.items():
        yield f"{name}: focus not calibrated ({why})"


def _basis(answer: ScaleAnswer) -> str:
    facts = answer.facts
    if answer.method == "board":
        return f"{facts['detections']} sightings of {facts['corners']} corners, residual {facts['residual_px']:.2f} px"
    if answer.method == "distance":
        return f"{facts['metres']:g} m between {' and '.join(facts['views'])}, for a ruler of 1 mm"
    offset = f"offset of the lens {1000 * facts['offset_m']:+.0f} mm"
    return f"{facts['points']} points of {facts['stacks']} stacks, {offset}, residual {facts['residual_dioptre']:.3f} dioptres"
