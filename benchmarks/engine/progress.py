"""How far long work has come: a bar on a terminal, lines in a log."""

import sys
import time
from typing import Any, Protocol

BAR = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"  # ticks have no unit that says anything


class Progress:
    """A bar with an ETA on a terminal; elsewhere a plain line now and then."""

    def __init__(self, total: int, label: str, every_s: float = 15) -> None:
        self.total, self.done, self._label, self._every = total, 0, label, every_s
        self._start = self._last = time.monotonic()
        self._bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm  # who has the environments alone has no bars

            self._bar = tqdm(total=total, desc=label, file=sys.stderr, leave=False, bar_format=BAR)

    def update(self, n: int, note: str = "") -> None:
        """n more are done; if it is negative, so many fewer are to be done."""
        if n < 0:
            self.total += n
            if self._bar is not None:
                self._bar.total = self.total
            return
        self.done += n
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(n)
        elif time.monotonic() - self._last > self._every:
            self._last, share = time.monotonic(), self.done / self.total
            left = f"{(self._last - self._start) * (1 / share - 1):.0f} s left" if share > 0.01 else "just begun"
            print(f"{self._label}: {share:4.0%}, {left} {note}".rstrip(), flush=True)

    def line(self, text: str) -> None:
        if self._bar is not None:
            self._bar.write(text)
        else:
            print(text, flush=True)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


class Ticks(Protocol):
    """Where a worker process tells how far it has come."""

    def put(self, ticks: int) -> None: ...


_ticks: Ticks  # of this worker process
_settled = 0  # ticks of the job in this process, done or not to be done


def tell(ticks: Ticks) -> None:
    """Let the jobs of this process tell their progress there."""
    global _ticks
    _ticks = ticks


def begin() -> None:
    """A job begins in this process."""
    global _settled
    _settled = 0


def tick(ticks: int) -> None:
    """Work in this process has come so much further."""
    global _settled
    _settled += ticks
    _ticks.put(ticks)


def skip(ticks: int) -> None:
    """So much of the work is not to be done: an interrupted run did it."""
    global _settled
    _settled += ticks
    _ticks.put(-ticks)


def give_up(ticks: int) -> None:
    """The job in this process, of so many ticks, ends here."""
    skip(max(ticks - _settled, 0))
