"""Arguments that several commands take."""

from pathlib import Path
from typing import Annotated

import typer

Scenes = Annotated[
    list[Path],
    typer.Argument(help="A data set (of `mrbokeh capture dataset`), or folders of merged focal stacks, or folders of such folders."),
]
