"""Write docs/reference/commands.md, all commands and options as the program has them: `python -m datasets_scripts.commands_page`."""

import re
from pathlib import Path
from typing import Any

from mrbokeh.cli import EVERY, SUB_COMMANDS, command_of
from mrbokeh.system.atomic_files import atomic_path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "commands.md"
TOP = """# Commands

Every command and option of `mrbokeh`, as `mrbokeh COMMAND --help` shows them. `python -m datasets_scripts.commands_page` writes this page.
"""


def commands_page() -> str:
    """Return the page in Markdown: the options of every command, then a section for each command with its own in their groups."""
    commands = {f"mrbokeh {name}": command_of(name) for name in SUB_COMMANDS}
    common = _panels(commands["mrbokeh doctor"])[EVERY]
    sections = (part for name, command in commands.items() for part in _sections(name, command, "##"))
    return "\n".join([TOP, "## Options of every command\n", "\n".join(common) + "\n", *sections])


def _sections(name: str, command: Any, level: str) -> list[str]:
    """Return the parts of a command and of the commands in it."""
    told = re.split(r"\n\s*\n", (command.help or "").strip())
    examples = [" ".join(part.split()).removeprefix("Example: ") for part in told if part.startswith("Example: ")]
    parts = [f"{level} `{name}`", *(" ".join(part.split()) for part in told if not part.startswith("Example: "))]
    if not hasattr(command, "commands") or command.invoke_without_command:
        parts.append("    " + " ".join([name, *command.collect_usage_pieces(command.context_class(command))]))
        parts += ["```sh\n" + "\n".join(examples) + "\n```"] if examples else []
        for panel, lines in _panels(command).items():
            parts += [] if panel == EVERY else [*([f"**{panel}**"] if panel else []), "\n".join(lines)]
    inner = (_sections(f"{name} {sub}", each, level + "#") for sub, each in getattr(command, "commands", {}).items())
    return [f"{part}\n" for part in parts] + [part for each in inner for part in each]


def _panels(command: Any) -> dict[str, list[str]]:
    """Return the lines of the arguments and options of a command by their group."""
    panels, context = dict[str, list[str]](), command.context_class(command)
    for each in sorted(command.params, key=lambda each: each.param_type_name):
        if record := each.get_help_record(context):
            panels.setdefault(getattr(each, "rich_help_panel", None) or "", []).append(_option(*record))
    return panels


def _option(words: str, told: str) -> str:
    """Return the line of an option; what it takes is told in one word, what must hold in brackets after its meaning."""
    meaning, _, conditions = told.partition("  [")
    takes = re.sub(r"<(?:list\[)?(\w+)(?:\]| range)?>", lambda found: f"<{found[1].lower()}>", words)
    return f"- `{takes}` {meaning}" + (f" *({conditions.rstrip(']')})*" if conditions else "")


if __name__ == "__main__":
    with atomic_path(PAGE) as temporary:
        temporary.write_text(commands_page(), encoding="utf-8")
