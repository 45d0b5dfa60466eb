"""The plain twin of all that spread by a bank: every pixel throws its light over the exact kernels around it, blended."""

import numpy as np

from mrbokeh.layering.psf_over_field import Channels, Plane
from mrbokeh.renderers.bank.around import Around
from mrbokeh.renderers.bank.spread import AnchorKernels


def scatter_side(kernels: AnchorKernels, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels:
    """See SpreadSide; kernels are blended over place (bilinearly) and diameter (linearly), summed in float64."""
    from mrbokeh.renderers.bank._scatter_numba import scatter_blended

    lattice = kernels.lattice
    lower, upper = lattice.diameter_shares(side, np.abs(coc_px))
    nodes = np.stack([lower, np.minimum(lower + 1, len(lattice.diameters_px[side]) - 1)], axis=-1)
    of_nodes = np.stack([1.0 - upper, upper], axis=-1)
    weights = (of_nodes[..., :, None] * around.shares[..., None, :]).reshape(*coc_px.shape, 8)
    weights = np.where(np.any(values != 0, axis=-1)[..., None], weights, 0.0)
    codes = (nodes[..., :, None] * lattice.anchors + around.anchors[..., None, :]).reshape(*coc_px.shape, 8)
    used = np.unique(codes[weights > 0.0])
    found = [kernels.kernel(side, *divmod(int(code), lattice.anchors))[..., channel] for code in used]
    taps = [kernel if side > 0 else kernel[::-1, ::-1] for kernel in found]
    radii_px = np.array([len(each) // 2 for each in taps], np.int64)
    starts = np.cumsum([0, *(each.size for each in taps[:-1])])
    margin, (height, width) = int(radii_px.max()), coc_px.shape
    padded = np.zeros((height + 2 * margin, width + 2 * margin, values.shape[2]))
    numbers = np.searchsorted(used, np.where(weights > 0.0, codes, used[0]))
    scatter_blended(
        padded, values.astype(np.float64), numbers, weights, np.concatenate([each.ravel() for each in taps]), starts, radii_px, margin
    )
    return padded[margin : margin + height, margin : margin + width].astype(np.float32)
