"""Being asked to stop: Ctrl-C, or the SIGTERM with which batch systems announce that time is up."""

import signal
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StoppedError(KeyboardInterrupt):
    """A run that was asked to stop did so; number: of the signal. left: what there is now, in words."""

    def __init__(self, number: int, left: str) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}; {left}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """The code that shells give: 130 after Ctrl-C, 143 after SIGTERM."""
        return 128 + self.number


class Interruption:
    """A block in which the signals only leave a note, so that a step is never torn; `asked` holds the last one.

    A signal that was ignored before stays so: shells start background jobs deaf to Ctrl-C.
    Of a process on its own a second Ctrl-C stops at once, without a checkpoint (torchrun passes on what its children have got already).
    """

    def __init__(self, alone: bool = True) -> None:
        self.asked: int | None = None
        self._alone = alone
        self._before: dict[int, object] = {}

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._note) for number in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self._alone and self.asked == number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = number
