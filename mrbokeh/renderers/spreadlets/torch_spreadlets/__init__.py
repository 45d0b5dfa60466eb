"""Laplacian spreadlets by torch: on an NVIDIA GPU, or on any processor that torch runs on (Leimkuehler et al. 2018, Section 6).

Two ways in. `LaplacianSpreadlets(device="cuda")` renders as ever and hands its sums to the device (`_sums.add_light_on`).
`TorchSpreadlets` is for what has to be quick: layers lie on the device as tensors, each pixel finds its kernel there, and the
picture stays there.

Sums are taken in whole numbers of 64 bits, scaled so that the largest sum that can occur is 2**61 at most. Whole numbers add up
the same in any order, so that atomic additions, chunks of any size and the Triton kernel all give the same bits, and a unit is
finer than the rounding of double precision of the largest sum. What may differ between devices, by rounding, is the integration:
sine transforms by torch.fft in double precision. In single precision they would be off by 2e-5 in a picture up to 1, and by 1e-4
where a lamp makes a disc of 80, as measured.

torch comes with the extra `train`; without it, importing this package says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

try:
    import torch
except ModuleNotFoundError as missing:
    from mrbokeh.system.errors import MissingExtraError

    raise MissingExtraError("torch", "train") from missing

from jaxtyping import Bool, Float32, Int32, Int64
from torch import Tensor
from torch.nn.functional import pad

from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.tables import BankTables
from mrbokeh.renderers.kernels.laplacian_integration import fast_width
from mrbokeh.renderers.kernels.spreadlets import UNRELAXED, Sparsification, Spreadlets
from mrbokeh.renderers.spreadlets.sums import FAR_FIELD_PX, Window
from mrbokeh.renderers.spreadlets.torch_spreadlets._kernels import BankCells, BankPoints, PointTable, stands_out
from mrbokeh.renderers.spreadlets.torch_spreadlets._sums import integrate, splat
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import device_named

__all__ = ["DeviceLayer", "TorchSpreadlets"]

Channels = Float32[Tensor, "height width channels"]


@dataclass(frozen=True)
class DeviceLayer:
    """Picture with holes, all of it on one device.

    rgba (H, W, 4): linear, premultiplied, HDR. coc_px (H, W): signed diameters of the circle of confusion. What else the bank
    asks for: motion_px (H, W, 2) right and down per shutter, field_xy (H, W, 2) in half diagonals, depth_m (H, W).
    """

    rgba: Float32[Tensor, "height width 4"]
    coc_px: Float32[Tensor, "height width"]
    motion_px: Float32[Tensor, "height width 2"] | None = None
    field_xy: Float32[Tensor, "height width 2"] | None = None
    depth_m: Float32[Tensor, "height width"] | None = None

    def continued(self, by_px: int) -> "DeviceLayer":
        """Return the layer, continued by so many border pixels on each side."""
        return replace(self, **{name: _continued(plane, by_px) for name, plane in vars(self).items() if plane is not None})


class TorchSpreadlets:
    """A bank of PSFs on a device, for layers that lie there.

    bank, sparsification, spreadlets: as for LaplacianSpreadlets. device: 'cuda', 'cuda:1', 'cpu'. Points of kernels, in each
    direction that occurs, are computed by the CPU when a picture first asks for them and then kept on the device: first
    pictures are slow. `spread` waits for the device twice a call, to learn which kernels it needs.
    """

    def __init__(
        self,
        bank: PsfBank,
        device: str = "cuda",
        sparsification: Sparsification | None = UNRELAXED,
        spreadlets: Spreadlets | None = None,
    ) -> None:
        self.device = device_named(device)
        self.bank = bank
        tables = BankTables(bank, sparsification, spreadlets)
        self._tables, self._cells = tables, BankCells(tables, self.device)
        self._dense, self._sparse = BankPoints(tables, True, self.device), BankPoints(tables, False, self.device)

    def picture(self, layers: Sequence[DeviceLayer], continued_px: int = 0) -> Float32[Tensor, "height width 4"]:
        """Return the layers, front first, each blurred and laid over those behind it; premultiplied colour and coverage.

        continued_px: layers go on beyond the frame as their border pixels do, so that light comes in from there.
        """
        if not layers:
            raise InputError("nothing to render: expected at least one layer, got none")
        result: Channels | None = None
        for layer in reversed(layers):
            light = self.sum_kernels(layer.continued(continued_px) if continued_px else layer)
            height, width, _ = light.shape
            light = light[continued_px : height - continued_px, continued_px : width - continued_px]
            result = light if result is None else over(light, result)
        assert result is not None
        return torch.cat([result[..., :3], result[..., 3:].mean(dim=2, keepdim=True)], dim=2)

    def sum_kernels(self, layer: DeviceLayer) -> Channels:
        """Return the sum over all pixels of light times kernel: R, G, B and coverage, or three coverages for a bank of three colours.

        See LaplacianSpreadlets.sum_bank_kernels, with which this agrees to rounding where Laplacians are whole. The
        far field of sparse points feels the border, which lies elsewhere here (2e-4 in a picture up to 4).
        """
        lit = (layer.rgba != 0).any(dim=2)
        where, bad = _finite(layer, lit)
        codes = self._cells.codes(stands_out(layer.rgba), where.coc_px, where.motion_px, where.field_xy, where.depth_m)
        values, colours = self._light(layer.rgba, codes)
        codes = torch.where(lit, codes, -1)
        largest, is_bad = torch.stack([values.abs().amax(), bad.any().float()]).tolist()
        if is_bad:
            raise InputError(
                "every visible pixel needs a finite circle of confusion and what else the bank asks for, but some have NaN or inf"
            )
        used = torch.nonzero(torch.bincount(codes.reshape(-1) + 1)[1:])[:, 0].cpu().numpy()
        out = torch.zeros_like(values)
        for is_dense, points in ((True, self._dense), (False, self._sparse)):
            mine = used[self._cells.dense[used // 2 // self._tables.angles] == is_dense]
            if mine.size:
                cells = codes if mine.size == used.size else torch.where(self._cells.is_dense(codes) == is_dense, codes, -1)
                out += self._summed(values, cells.int(), points.of(mine), is_dense, largest, colours)
        return out

    def _light(self, rgba: Channels, codes: Int64[Tensor, "height width"]) -> tuple[Float32[Tensor, "height width sums"], list[int]]:
        """Return the channels to sum, and the colour of the kernel that each takes; coverage goes through kernels that sum to 1."""
        coverage = rgba[..., 3:] / self._cells.light(codes)
        return torch.cat([rgba[..., :3], coverage], dim=2), [0] * 4 if self.bank.channels == 1 else [0, 1, 2, 0, 1, 2]

    def _summed(
        self, values: Channels, cells: Int32[Tensor, "height width"], table: PointTable, is_dense: bool, largest: float, colours: list[int]
    ) -> Channels:
        height, width = cells.shape
        margin = table.reach_px + (0 if is_dense else 1 + FAR_FIELD_PX)
        rows, columns = height + 2 * margin, width + 2 * margin
        window = Window(-margin, -margin, *(rows, columns) if is_dense else (fast_width(rows + 1) - 1, fast_width(columns)))
        sums = splat(values, cells, table, window, largest, colours)
        light = sums if is_dense else integrate(sums)
        return light[:, margin : margin + height, margin : margin + width].permute(1, 2, 0).float()


def over(front: Channels, behind: Channels) -> Channels:
    """Lay light in front over that behind it, by one coverage or by one for each colour; coverages come last."""
    free = 1.0 - front[..., 3:].clamp(0.0, 1.0)
    return front + (free if free.shape[2] == 1 else torch.cat([free, free], dim=2)) * behind


def _finite(layer: DeviceLayer, lit: Bool[Tensor, "height width"]) -> tuple[DeviceLayer, Bool[Tensor, "height width"]]:
    """Return the layer with 0 where a plane is not a number, so that it may index tables, and where that is seen. Depth may be inf."""
    bad = lit & ~torch.isfinite(layer.coc_px)
    for plane in (layer.motion_px, layer.field_xy):
        bad |= lit & (False if plane is None else ~torch.isfinite(plane).all(dim=2))
    bad |= lit & (False if layer.depth_m is None else torch.isnan(layer.depth_m))
    clean = {name: torch.nan_to_num(plane, 0.0, 0.0, 0.0) for name, plane in vars(layer).items() if plane is not None}
    if layer.depth_m is not None:
        clean["depth_m"] = torch.nan_to_num(layer.depth_m, 0.0, torch.inf, 0.0)
    return replace(layer, **{**clean, "rgba": layer.rgba}), bad


def _continued(plane: Tensor, by_px: int) -> Tensor:
    """Return planes (H, W) or (H, W, C) with their border pixels repeated."""
    planes = plane.reshape(*plane.shape[:2], -1).permute(2, 0, 1)
    wider = pad(planes, (by_px,) * 4, mode="replicate").permute(1, 2, 0)
    return wider.reshape(*wider.shape[:2], *plane.shape[2:]).contiguous()
