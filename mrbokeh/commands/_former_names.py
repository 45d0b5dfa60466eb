"""Options that were called something else go on working under that name, which no help text shows."""

from collections.abc import Mapping, Sequence
from typing import Any

from typer.core import TyperCommand

from mrbokeh.system.console import flag, spelled_out


def formerly(*parameters: str, **now_by_former: str) -> type[TyperCommand]:
    """The class for a command some of whose options had other names: `@app.command(cls=formerly("frame_rate", width="--image-width"))`.

    parameters: those whose options were their names spelled out; `mrbokeh.system.console` says what they are called now.
    """
    renamings = {name: flag(name) for name in parameters} | now_by_former
    names = {spelled_out(former): now for former, now in renamings.items()}

    class Renaming(TyperCommand):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            return super().parse_args(ctx, renamed(args, names))

    return Renaming


def renamed(args: Sequence[str], names: Mapping[str, str]) -> list[str]:
    """Arguments with --former and --former=VALUE under their names of now; nothing behind a lone -- is an option."""
    options = args.index("--") if "--" in args else len(args)
    return [*(_renamed(each, names) for each in args[:options]), *args[options:]]


def _renamed(argument: str, names: Mapping[str, str]) -> str:
    name, equals, value = argument.partition("=")
    return names.get(name, name) + equals + value
