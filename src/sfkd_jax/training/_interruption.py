"""SIGINT and SIGTERM stop training promptly, also while compiled code runs."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType, TracebackType
from typing import Any

import jax

_POLL_S = 0.02
"""Interval at which a wait checks for a signal [s]."""


class Interrupted(KeyboardInterrupt):
    """A signal requested a stop; no file was being written."""


class Interruption:
    """A context that turns SIGINT and SIGTERM into `Interrupted` at the next wait.

    Python runs no handler while it compiles or waits for a result, which may take
    minutes; here both are waited for in small steps. A second signal has its previous
    effect, and signals that have a handler already are left alone.
    """

    def __init__(self) -> None:
        """Start without a request."""
        self._requested = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        """Install handlers, in the main thread and for signals with their default."""
        if threading.current_thread() is threading.main_thread():
            usual = {
                signal.SIGINT: signal.default_int_handler,
                signal.SIGTERM: signal.SIG_DFL,
            }
            for number, handler in usual.items():
                if signal.getsignal(number) == handler:
                    self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restore the handlers; raise a pending request."""
        self._restore()
        if kind is None:
            self._raise_if_requested()

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._requested = True
        self._restore()

    def _restore(self) -> None:
        while self._previous:
            signal.signal(*self._previous.popitem())

    def _raise_if_requested(self) -> None:
        if self._requested:
            raise Interrupted

    def ready(self, result: Any) -> Any:
        """Wait until all arrays of a pytree are computed and return it."""
        for leaf in jax.tree.leaves(result):
            wait = 1e-4
            while not leaf.is_ready():
                self._raise_if_requested()
                time.sleep(wait)
                wait = min(2 * wait, _POLL_S)
        self._raise_if_requested()
        return result

    def compiled(self, function: Any, *arguments: Any) -> Any:
        """Compile a jitted function for these arguments and return it."""
        lowered = function.lower(*arguments)
        programs, errors = [], []

        def build() -> None:
            try:
                programs.append(lowered.compile())
            except BaseException as reason:  # raised again in the waiting thread
                errors.append(reason)

        builder = threading.Thread(target=build, daemon=True)
        builder.start()
        while builder.is_alive():
            builder.join(_POLL_S)
            self._raise_if_requested()
        if errors:
            raise errors[0]
        return programs[0]
