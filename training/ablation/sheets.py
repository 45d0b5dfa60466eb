"""The picture of a table: crops of a few held-out slices, truth first, then every row, as in the paper's Figures 4 and 5."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrbokeh.images.image_io import SheetRow, write_contact_sheet
from mrbokeh.images.image_metrics import psnr
from training.ablation.plan import DataSet, run_folder
from training.ablation.rows import FILE_NAMES, Row, TableName
from training.ablation.runs import device_of
from training.blur_functions import Blur, blur_of
from training.dataset import PairSet
from training.evaluation.sheets import enlarged, telling_windows
from training.evaluation.unseen_slice import UnseenSlice, unseen_slice
from training.stacks import stack_name
from training.weights import WHERE_TRUTH_IS_KNOWN

SLICES_OF_A_SET = 2


def write_sheet(out: Path, table: TableName, rows: Sequence[Row], data_sets: Sequence[DataSet], device: str = "cpu") -> Path:
    """rows: those that are finished on all of the sets, with seed 0."""
    path = out / f"{FILE_NAMES[table]}.png"
    sheet = []
    for each in data_sets:
        blurs = {row.title: blur_of(run_folder(out, each.name, row, 0), device_of(device))[0] for row in rows}
        sheet += [row for seen in _slices(each) for row in _sheet_rows(f"{each.name} slice {seen.index}", seen, blurs)]
    write_contact_sheet(path, sheet)
    return path


def _slices(data_set: DataSet) -> list[UnseenSlice]:
    """The first and the last slice of the first held-out stack: the nearest and the farthest focus, where blur is largest."""
    stacks = [stack for stack in data_set.data.stacks if stack_name(stack) in data_set.held_out][:1]
    pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0)
    chosen = np.unique(np.linspace(0, len(pairs) - 1, SLICES_OF_A_SET).round().astype(int))
    return [unseen_slice(pairs, int(index)) for index in chosen]


def _sheet_rows(label: str, seen: UnseenSlice, blurs: dict[str, Blur]) -> list[SheetRow]:
    results = {title: blur(seen.pair) for title, blur in blurs.items()}
    truth = seen.pair.target
    captions = {title: f"{title} {psnr(picture, truth, mask=seen.counted):.1f} dB" for title, picture in results.items()}
    shown = {"input": seen.pair.all_in_focus, "truth": truth} | {captions[title]: picture for title, picture in results.items()}
    windows = telling_windows(seen, next(iter(results.values())))
    return [
        SheetRow(f"{label}, {what}", {caption: enlarged(picture[window]) for caption, picture in shown.items()})
        for what, window in windows.items()
    ]
