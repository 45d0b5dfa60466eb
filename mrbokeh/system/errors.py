"""Errors that the user can mend: the command line prints them as one sentence, without a traceback."""

import errno
import json
import os
import re
import sys
import tempfile
import traceback
from contextlib import suppress
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C stopped, as shells have it."""

FAULT = 1
"""Exit code of a command that ended by a fault of ours."""


# Where a module can be missing because its extra was not installed.
EXTRA_OF_MODULE = {
    "rawpy": "capture",
    "pyexiv2": "capture",
    "lensfunpy": "capture",
    "pycolmap": "capture",
    "gphoto2": "tether",
    "torch": "train",
    "onnx": "train",
    "onnxscript": "train",
    "aiohttp": "viewfinder",
    "h5py": "hdf5",
}


class InputError(ValueError):
    """Bad input. The message says what was expected, what came, and what to do next."""


def require_file(path: Path | str, expected: str, advice: str = "") -> None:
    """Raise InputError unless there is a file. expected: what it should be; advice: what to do, put behind the sentence."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"expected {expected} at {path}, but it is a folder{advice}")
    if not path.exists():
        link = f"it is a link to {os.readlink(path)}, which leads nowhere" if path.is_symlink() else "there is no such file"
        if re.search(r"%(0\d)?d|#+\.|\$F\d", path.name):
            link = "that stands for many numbered ones: name one of them"
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
    from importlib.metadata import PackageNotFoundError, distribution

    source = ""
    with suppress(PackageNotFoundError, ValueError):
        # PEP 610: pip notes there what it was given.
        noted = json.loads(distribution("mrbokeh").read_text("direct_url.json") or "{}")
        source = f"{noted['vcs_info']['vcs']}+{noted['url']}" if "vcs_info" in noted else str(noted.get("url", ""))
    return f"pip install 'mrbokeh{chosen} @ {source}'" if source else f"pip install 'mrbokeh{chosen}'"


def mistake_in(error: Exception) -> str:
    """Return the sentence for an error that the user can mend, else ""."""
    if isinstance(error, InputError):
        return str(error)
    if hasattr(error, "format_message"):
        return _of_parser(error)
    if isinstance(error, ModuleNotFoundError):
        extra = EXTRA_OF_MODULE.get((error.name or "").partition(".")[0])
        return str(MissingExtraError(str(error.name), extra)) if extra else ""
    if isinstance(error, RuntimeError) and "Symlink loop" in str(error):
        return f"{str(error).partition(' from ')[2]} is a link that leads back to itself: name the file that is meant"
    if isinstance(error, MemoryError):
        return "there is not enough memory for this: use smaller pictures (--max-width where there is one) or fewer at once"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "there is no space left where this was written, or in the temporary folder: free some and run the same command again"
    if isinstance(error, OSError) and isinstance(error.filename, str | bytes):
        return _refused(error)
    return ""


_PARSERS_WORDS = {
    "Input should be less than or equal to": "expected at most",
    "Input should be greater than or equal to": "expected at least",
    "Input should be less than": "expected less than",
    "Input should be greater than": "expected more than",
    "Input should be a valid number, unable to parse string as a number": "expected a number",
    "Input should be a valid integer, unable to parse string as an integer": "expected a whole number",
}


def _of_parser(error: Any) -> str:
    """Return the sentence of the command line's parser, with what was typed and where it is told what may be."""
    if getattr(error, "possibilities", None):
        typed_name = str(error.option_name).lstrip("-")
        error.possibilities = ["--" + each for each in get_close_matches(typed_name, [each.lstrip("-") for each in error.possibilities])]
    text = str(error.format_message()).rstrip(".")
    for theirs, ours in _PARSERS_WORDS.items():
        text = text.replace(theirs, ours)
    text += "; a name with spaces needs quotes" if "unexpected extra argument" in text else ""
    words, context = sys.argv[1:], getattr(error, "ctx", None)
    names: list[str] = list(getattr(getattr(error, "param", None), "opts", ()))
    typed = [value for name, value in pairwise(words) if name in names]
    typed += [word.partition("=")[2] for word in words if word.partition("=")[0] in names and "=" in word]
    got = f", got {typed[-1]!r}" if typed and names[0].startswith("-") and not text.startswith("Missing") else ""
    return f"{text}{got}: see `{context.command_path} --help`" if context is not None else text + got


def fault_in(error: Exception) -> str:
    """Keep the traceback in a file, where one can be written, and return what to do with it."""
    kept, text = "`mrbokeh --debug ...`", " ".join(sys.argv) + "\n\n" + "".join(traceback.format_exception(error))
    with suppress(OSError), tempfile.NamedTemporaryFile("wb", prefix="mrbokeh-fault-", suffix=".txt", delete=False) as file:
        file.write(text.encode("utf-8", "backslashreplace"))
        kept = file.name
    first = (str(error).splitlines() or [""])[0]
    return (
        f"this is a fault of mrbokeh ({type(error).__name__}{': ' + first if first else ''}). "
        f"Please report it with {kept}; `mrbokeh --debug ...` shows it here"
    )


def _refused(error: OSError) -> str:
    """Describe what the system refused to do with a file or folder; for a temporary file, name its folder."""
    path = Path(os.fsdecode(error.filename))
    shown = path.parent if path.name.startswith(".") and ".part" in path.name else path
    if isinstance(error, FileNotFoundError):
        return f"{shown}: there is no such file or folder: check the name"
    if isinstance(error, IsADirectoryError):
        return f"{shown} is a folder (it is a directory), but a file was expected there: check the name"
    if isinstance(error, NotADirectoryError | FileExistsError):
        return f"{shown}: a file is where a folder was expected: check the name"
    return f"{shown}: {(error.strerror or 'the system refused it').lower()}; check the name, the space left and who may write there"
