"""The command `mrbokeh train doctor`."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.channel import tell


def doctor_command(
    run: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")],
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Its data set or focal stacks, if they are no longer where they were (repeat for more folders)."),
    ] = None,
) -> None:
    """Say what is wrong with a training run, each with its evidence and what to do.

    It looks at the curve, and at a few slices it learnt from and held-out ones, with the network beside no blur and a plain disc.

    Example: mrbokeh train doctor runs/attic
    """
    from training.data.training_data import focal_stacks, training_data
    from training.evaluation.diagnosis import diagnose

    diagnosis = diagnose(run, focal_stacks(training_data(data).stacks) if data else ())
    for number, sentence in enumerate(diagnosis.found, 1):
        tell(f"{number}. {sentence}")
    if diagnosis.found:
        tell("other options mean another run: give another --out with them, or --overwrite")
    if not diagnosis.found and not diagnosis.unseen:
        tell("nothing found wrong")
    tell(f"looked at: {'; '.join(diagnosis.looked)}", found=diagnosis.found, looked_at=diagnosis.looked, not_looked_at=diagnosis.unseen)
    if diagnosis.unseen:
        why = "its network is not finished" if diagnosis.has_pictures else "its pictures are not where they were, give --data"
        tell(f"not looked at, as {why}: {'; '.join(diagnosis.unseen)}")
