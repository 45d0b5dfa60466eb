"""Errors that the user can mend: the command line prints them as one sentence, without a traceback."""

import json
import os
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C stopped, as shells have it."""

FAULT = 1
"""Exit code of a command that ended by a fault of ours."""


class InputError(ValueError):
    """Bad input. The message says what was expected, what came, and what to do next."""


def require_file(path: Path | str, expected: str, advice: str = "") -> None:
    """Raise InputError unless there is a file. expected: what it should be; advice: what to do, put behind the sentence."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"expected {expected} at {path}, but it is a folder{advice}")
    if not path.exists():
        link = f"it is a link to {os.readlink(path)}, which leads nowhere" if path.is_symlink() else "there is no such file"
        raise InputError(f"expected {expected} at {path}, but {link}{advice}")


class MissingExtraError(InputError):
    """A package of an optional extra is not installed; the message names the pip command that adds it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"this command needs the package {package!r}, which is not installed. Add it with: {install_command(extra)}")


def install_command(extra: str = "") -> str:
    """Return the pip command that adds an extra to this installation, from where it was installed: a checkout, a wheel, or an index.

    The bare name would be wrong in the first two: an index may hold a package of another project under it.
    """
    chosen, checkout = f"[{extra}]" if extra else "", Path(__file__).resolve().parents[2]
    if (checkout / "pyproject.toml").is_file():
        return f"pip install -e '{checkout}{chosen}'"
    source = ""
    with suppress(PackageNotFoundError, ValueError):
        # PEP 610: pip notes there what it was given.
        noted = json.loads(distribution("mrbokeh").read_text("direct_url.json") or "{}")
        source = f"{noted['vcs_info']['vcs']}+{noted['url']}" if "vcs_info" in noted else str(noted.get("url", ""))
    return f"pip install 'mrbokeh{chosen} @ {source}'" if source else f"pip install 'mrbokeh{chosen}'"
