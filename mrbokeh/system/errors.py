"""Errors that the user can mend: the command line prints them as one sentence, without a traceback."""

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C stopped, as shells have it."""

FAULT = 1
"""Exit code of a command that ended by a fault of ours."""


class InputError(ValueError):
    """Bad input. The message says what was expected, what came, and what to do next."""


class MissingExtraError(InputError):
    """A package of an optional extra is not installed; the message names the pip command that adds it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"this command needs the package {package!r}, which is not installed. Add it with: pip install 'mrbokeh[{extra}]'")
