"""Options of `mrbokeh composite` and `mrbokeh video` that make virtual light look photographed."""

from pathlib import Path
from typing import Annotated

import typer

LOOK = "Its look"

MatchGreyOption = Annotated[
    str | None,
    typer.Option(metavar="X,Y[,R]", help="A grey card in the plate sets exposure and white balance.", rich_help_panel=LOOK),
]
GreyValueOption = Annotated[float, typer.Option(help="What the card reflects.", rich_help_panel=LOOK)]
MatchExposureOption = Annotated[
    Path | None,
    typer.Option(metavar="PHOTO", help="Photograph of which the virtual light was made: exposures are matched.", rich_help_panel=LOOK),
]
MatchWhiteOption = Annotated[
    float | None, typer.Option(metavar="KELVIN", help="Light that the plate was balanced for.", rich_help_panel=LOOK)
]
MatchBlackOption = Annotated[
    str | None, typer.Option(metavar="auto|X,Y[,R]", help="Virtual blacks are lifted to the plate's.", rich_help_panel=LOOK)
]
VignettingOption = Annotated[
    str | None, typer.Option(metavar="auto|K1,K2,K3|FLAT.png", help="The lens darkens virtual light too.", rich_help_panel=LOOK)
]
GrainOption = Annotated[
    str | None, typer.Option(metavar="auto|FILE", help="Grain as measured in the plate, on virtual light.", rich_help_panel=LOOK)
]
LightWrapOption = Annotated[
    str | None, typer.Option(metavar="STRENGTH[,SIGMA]", help="Light of the plate over virtual edges.", rich_help_panel=LOOK)
]
SeedOption = Annotated[int, typer.Option(help="Of the grain.", rich_help_panel=LOOK)]
