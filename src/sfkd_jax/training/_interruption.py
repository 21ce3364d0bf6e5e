"""Stopping on request: SIGINT and SIGTERM are answered within moments, also while compiled code runs."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType, TracebackType
from typing import Any

import jax

_LOOK_S = 0.02
"""How often a wait looks for a signal [s]."""


class Interrupted(KeyboardInterrupt):
    """A signal asked to stop; nothing was in the middle of being written."""


class Interruption:
    """A context in which SIGINT and SIGTERM are kept until something is waited for, and then raise `Interrupted`.

    Python runs no handler while it is inside a compiler or waits for a result, which
    may take minutes: so both are waited for in small steps. A second signal, and
    signals that somebody else handles, do what they did before.
    """

    def __init__(self) -> None:
        """Nothing is asked for yet."""
        self._asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        """Take the signals over, where this thread may and nobody else did."""
        if threading.current_thread() is threading.main_thread():
            usual = {
                signal.SIGINT: signal.default_int_handler,
                signal.SIGTERM: signal.SIG_DFL,
            }
            for number, handler in usual.items():
                if signal.getsignal(number) == handler:
                    self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the signals back; one that nothing has answered is answered now."""
        self._give_back()
        if kind is None:
            self._answer()

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
        self._give_back()

    def _give_back(self) -> None:
        while self._before:
            signal.signal(*self._before.popitem())

    def _answer(self) -> None:
        if self._asked:
            raise Interrupted

    def ready(self, result: Any) -> Any:
        """A pytree of arrays, once they are computed."""
        for leaf in jax.tree.leaves(result):
            wait = 1e-4
            while not leaf.is_ready():
                self._answer()
                time.sleep(wait)
                wait = min(2 * wait, _LOOK_S)
        self._answer()
        return result

    def compiled(self, function: Any, *arguments: Any) -> Any:
        """A jitted function, compiled for these arguments."""
        lowered, made, failed = function.lower(*arguments), [], []

        def build() -> None:
            try:
                made.append(lowered.compile())
            except BaseException as reason:  # raised where it is waited for
                failed.append(reason)

        builder = threading.Thread(target=build, daemon=True)
        builder.start()
        while builder.is_alive():
            builder.join(_LOOK_S)
            self._answer()
        if failed:
            raise failed[0]
        return made[0]
