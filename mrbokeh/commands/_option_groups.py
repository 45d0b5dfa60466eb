"""Options in groups: frozen dataclasses whose fields are options, so that commands share them and hand them on whole.

@dataclass(frozen=True)
class NearOptions:
    matte: Annotated[Path | None, typer.Option(help="...")] = None

@app.command()
@grouped
def video(clip: ClipArgument, near: NearOptions) -> None: ...      # mrbokeh video CLIP --matte MATTE.png
"""

from collections.abc import Callable
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Any, get_type_hints


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """The command with an option for each field, by its name, type and default, in place of every parameter that is a dataclass."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hints[name] for name in signature(command).parameters if is_dataclass(hints[name])}

    @wraps(command)
    def with_options(**given: Any) -> None:
        whole = {name: _group_of(group, given) for name, group in groups.items()}
        command(**given, **whole)

    shown: list[Parameter] = []
    for name, parameter in signature(command).parameters.items():
        of_group = _options_of(groups[name]) if name in groups else [parameter.replace(annotation=hints[name])]
        shown += [each.replace(kind=Parameter.KEYWORD_ONLY) for each in of_group]
    with_options.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    with_options.__annotations__ = {each.name: each.annotation for each in shown}
    return with_options


def _group_of(group: type, given: dict[str, Any]) -> Any:
    """Return a group, and groups within it, of what is given, which is taken out of there."""
    hints = get_type_hints(group, include_extras=True)
    values = {
        each.name: _group_of(hints[each.name], given) if is_dataclass(hints[each.name]) else given.pop(each.name) for each in fields(group)
    }
    return group(**values)


def _options_of(group: type) -> list[Parameter]:
    """Return the options of a group, and of groups within it, in their order."""
    hints = get_type_hints(group, include_extras=True)
    shown: list[Parameter] = []
    for each in fields(group):
        hint = hints[each.name]
        one = Parameter(each.name, Parameter.KEYWORD_ONLY, default=_default(each), annotation=hint)
        shown += _options_of(hint) if isinstance(hint, type) and is_dataclass(hint) else [one]
    return shown


def _default(option: "Field[Any]") -> Any:
    return Parameter.empty if option.default is MISSING else option.default
