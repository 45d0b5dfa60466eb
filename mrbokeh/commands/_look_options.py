"""Options of `mrbokeh composite` and `mrbokeh video` that make virtual light look photographed."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mrbokeh.compositing.plate_look.look_options import LookOptions

LOOK = "Its look"


@dataclass(frozen=True)
class LookGroup:
    """Texts as typed, as `mrbokeh.compositing.plate_look.look_options.LookOptions` has them."""

    match_grey: Annotated[
        str | None,
        typer.Option(metavar="X,Y[,R]", help="A grey card in the plate sets exposure and white balance.", rich_help_panel=LOOK),
    ] = None
    grey_value: Annotated[float, typer.Option(help="What the card reflects.", rich_help_panel=LOOK)] = 0.18
    match_exposure: Annotated[
        Path | None,
        typer.Option(
            metavar="PHOTO",
            help="Photograph of which the virtual light was made: exposures are matched, by what both state of theirs.",
            rich_help_panel=LOOK,
        ),
    ] = None
    plate_exposure: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS,ISO,F",
            help="Exposure of the plate for --match-exposure, such as 1/50,400,2.8, where its file states none: any video.",
            rich_help_panel=LOOK,
        ),
    ] = None
    match_white: Annotated[
        float | None, typer.Option(metavar="KELVIN", help="Light that the plate was balanced for.", rich_help_panel=LOOK)
    ] = None
    match_black: Annotated[
        str | None, typer.Option(metavar="auto|X,Y[,R]", help="Virtual blacks are lifted to the plate's.", rich_help_panel=LOOK)
    ] = None
    vignetting: Annotated[
        str | None, typer.Option(metavar="auto|K1,K2,K3|FLAT.png", help="The lens darkens virtual light too.", rich_help_panel=LOOK)
    ] = None
    grain: Annotated[
        str | None, typer.Option(metavar="auto|FILE", help="Grain as measured in the plate, on virtual light.", rich_help_panel=LOOK)
    ] = None
    light_wrap: Annotated[
        str | None, typer.Option(metavar="STRENGTH[,SIGMA]", help="Light of the plate over virtual edges.", rich_help_panel=LOOK)
    ] = None
    seed: Annotated[int, typer.Option(help="Of the grain.", rich_help_panel=LOOK)] = 0

    @property
    def wanted(self) -> "LookOptions":
        from mrbokeh.compositing.plate_look.look_options import LookOptions

        matched = (self.match_grey, self.grey_value, self.match_exposure, self.match_white, self.match_black)
        return LookOptions(*matched, self.vignetting, self.grain, self.light_wrap, self.seed, self.plate_exposure)
