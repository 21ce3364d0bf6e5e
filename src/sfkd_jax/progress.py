"""How far long work is: a bar on a terminal, lines with times where there is none."""

from __future__ import annotations

import sys
import time
from typing import Any

from sfkd_jax.store import print_message

APART = 30.0
"""Time after which there is a new line where there is no bar [s]."""


class Progress:
    """Work in steps that are counted, with the time that is left.

    On a terminal it is a bar of tqdm, if that is installed. Elsewhere, such as in the
    log of a batch job, there is a line for every text, and one at least every `APART`
    seconds.

        with Progress("training", 6000) as progress:
            progress.advance(50, "loss 1.2")
    """

    def __init__(self, name: str, total: int, done: int = 0) -> None:
        """Begin.

        Args:
            name: of the work.
            total: number of steps.
            done: steps that were done before.
        """
        self._name = name
        self._total = total
        self._first = done
        self._done = done
        self._began = time.monotonic()
        self._said = self._began
        self._bar = _bar(name, total, done)

    def __enter__(self) -> Progress:
        """Return it, to be closed at the end."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def advance(self, count: int = 1, text: str = "") -> None:
        """Count steps that were done.

        Args:
            count: number of steps.
            text: what is known now, to be shown; "" for nothing new.
        """
        self._done += count
        if self._bar is not None:
            if text:
                self._bar.set_postfix_str(text, refresh=False)
            self._bar.update(count)
        elif text or time.monotonic() - self._said >= APART:
            self._say(f": {text}" if text else "")

    def _say(self, text: str) -> None:
        """Print a line with what is done so far, and the time that is left."""
        self._said = time.monotonic()
        clock = time.strftime("%H:%M:%S")
        counted = f"{clock} {self._name} {self._done:,} / {self._total:,}"
        print_message(f"{counted}, {self._left()} left{text}")

    def _left(self) -> str:
        """Return the time that is left at the rate so far, such as "1:20"."""
        done = self._done - self._first
        if not done:
            return "?"
        seconds = (self._said - self._began) / done * (self._total - self._done)
        minutes, rest = divmod(round(seconds), 60)
        hours, minutes = divmod(minutes, 60)
        return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _bar(name: str, total: int, done: int) -> Any:
    """Return a bar on the terminal; None without a terminal or without tqdm."""
    if not sys.stderr.isatty():
        return None
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(desc=name, total=total, initial=done, file=sys.stderr)
