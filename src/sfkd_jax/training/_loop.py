"""The training loop: deterministic, resumable, stopped by a non-finite loss."""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from sfkd_jax.ranges import Positive
from sfkd_jax.store import truncate_jsonl
from sfkd_jax.training._checkpoints import RESUME_HINT, Checkpoints
from sfkd_jax.training._losses import Loss
from sfkd_jax.types import Key, Model, Params, Trajectory

Draw: TypeAlias = Callable[[Trajectory, Key], Trajectory]
WARM_UP = 100
"""Steps until the largest learning rate, in all but short runs."""
FINAL_RATE = 0.01
"""Last learning rate relative to the largest."""


class TrainingStopped(RuntimeError):
    """Training cannot continue; the message names the last checkpoint."""


class TrainState(NamedTuple):
    """The whole state of training; random keys are derived from `step`."""

    step: jax.Array
    params: Params
    optimizer: Any


def fit(
    model: Model,
    loss: Loss,
    draw: Draw,
    data: Trajectory,
    held_out: Trajectory,
    key: Key,
    directory: Path,
    *,
    steps: int = 4000,
    learning_rate: Positive = 3e-3,
    clip_norm: Positive = 100.0,
    log_every: int = 50,
    save_every: int = 500,
    inspect: Callable[[Params], dict[str, float]] | None = None,
) -> tuple[Params, int]:
    """Train and return the parameters with the lowest validation loss.

    Adam with linear warm-up and cosine decay. A run that `directory` contains is
    resumed. Batches depend on the key and the step only, so an interrupted run ends
    bit-identical to an uninterrupted one. SIGINT or SIGTERM saves the state after the
    steps that are being computed and raises; a second one ends the process.

    Args:
        model: to be trained. To train on from given parameters, a model whose `init`
            returns them: `model._replace(init=lambda key: params)`.
        loss: (params, batch of windows) -> loss, parts.
        draw: (data, key) -> a batch of windows.
        data: the training trajectories.
        held_out: windows of the validation loss.
        key: for the initial parameters and the batches.
        directory: for checkpoints/ and metrics.jsonl.
        steps: optimiser steps.
        learning_rate: the largest.
        clip_norm: largest global gradient norm.
        log_every: steps per compiled chunk and per log line.
        save_every: steps per checkpoint, a multiple of `log_every`.
        inspect: params -> more finite numbers to log at every checkpoint, by name (what
            can be certified, for example).

    Returns:
        The best parameters, and the step at which they were reached.

    Raises:
        TrainingStopped: the loss or a gradient is not finite.
        KeyboardInterrupt: on SIGINT or SIGTERM.
        ValueError: steps or save_every are no multiples of log_every.
    """
    if save_every % log_every or steps % log_every:
        raise ValueError(
            "training.steps and save_every must be multiples of "
            f"log_every = {log_every}"
        )
    # Batches have a stream of their own: a resumed run draws the same ones.
    init_key, data_key = jax.random.split(key)
    transform, schedule = _optimizer(steps, learning_rate, clip_norm)
    # Compiled, since initialisers op by op take seconds for many small matrices.
    params = jax.jit(model.init)(init_key)
    state = TrainState(jnp.zeros((), jnp.int32), params, transform.init(params))
    checkpoints = Checkpoints(directory / "checkpoints")
    try:
        state = checkpoints.resume(state)
        # 0 for a new run, whose state `resume` returned as it was.
        start = int(state.step)
        log = open_log(directory / "metrics.jsonl", resumed_at=start)
        advance = _chunk(loss, transform, draw, length=log_every)
        validate, began = jax.jit(loss), time.perf_counter()
        with _requests() as requested:
            for done in range(start + log_every, steps + 1, log_every):
                state, means = advance(state, data, data_key)
                record = {name: float(value) for name, value in means.items()}
                record |= {
                    "step": done,
                    "learning_rate": float(jnp.asarray(schedule(done))),
                    "seconds": time.perf_counter() - began,
                }
                saves = done % save_every == 0 or done == steps
                # Only where a state is saved: it is there to choose between states.
                if saves:
                    total, parts = validate(state.params, held_out)
                    record["validation_loss"] = float(total)
                    record["validation_prediction"] = float(parts["prediction"])
                    record |= inspect(state.params) if inspect else {}
                _require_finite(record, done, checkpoints)
                # Before the checkpoint: a resumed run can drop lines, but not add them.
                append(log, record, steps=steps)
                # A state between two checkpoints is saved to resume from, but never
                # selected as the best: an uninterrupted run does not have it.
                score = record["validation_loss"] if saves else math.inf
                # Looked at once, so that a signal from here on finds the next state.
                stop = bool(requested)
                if saves or stop:
                    checkpoints.save(done, state, validation_loss=score)
                if stop:
                    break
        # Also for a signal during the last step: what follows shall not begin.
        if requested:
            raise KeyboardInterrupt
        best = checkpoints.best_step() or steps
        return checkpoints.restore(best, state).params, best
    # Also after an error: the caller may open the directory again to resume.
    finally:
        checkpoints.close()


def _optimizer(
    steps: int, learning_rate: float, clip_norm: float
) -> tuple[optax.GradientTransformation, optax.Schedule]:
    """Adam with linear warm-up and cosine decay, and its learning rate schedule."""
    # A tenth of a short run, which would end before its largest rate otherwise.
    rise = min(WARM_UP, max(steps // 10, 1))
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, learning_rate, rise, max(steps, rise + 1), learning_rate * FINAL_RATE
    )
    # Before Adam: one exploding batch would spoil its moments for long.
    clip = optax.clip_by_global_norm(clip_norm)
    return optax.chain(clip, optax.adam(schedule)), schedule


def _chunk(
    loss: Loss, transform: optax.GradientTransformation, draw: Draw, *, length: int
) -> Any:
    """Compile `length` optimiser steps: (state, data, key) -> state, mean metrics."""
    gradient = jax.value_and_grad(loss, has_aux=True)

    # The key is an argument, so that trainings from other seeds share a program.
    @jax.jit
    def chunk(
        state: TrainState, data: Trajectory, key: Key
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            # From the step, not from a carried key:
            # a resumed run draws the same batches.
            batch = draw(data, jax.random.fold_in(key, state.step))
            (total, parts), grads = gradient(state.params, batch)
            updates, memory = transform.update(grads, state.optimizer, state.params)
            after = TrainState(
                state.step + 1, optax.apply_updates(state.params, updates), memory
            )
            return after, {
                "loss": total,
                "gradient_norm": optax.tree.norm(grads),
                **parts,
            }

        # Many steps in one program: dispatching each would take longer than the step.
        state, records = jax.lax.scan(step, state, length=length)
        return state, jax.tree.map(jnp.mean, records)

    return chunk


def _require_finite(
    record: dict[str, float], step: int, checkpoints: Checkpoints
) -> None:
    """Raise TrainingStopped if any entry of a record is not finite."""
    # Every entry, also those of `inspect`: a NaN there means bad parameters as well.
    if not all(math.isfinite(value) for value in record.values()):
        raise TrainingStopped(
            f"non-finite loss near step {step}; "
            f"the last good checkpoint is step {checkpoints.latest_step()}"
        )


@contextmanager
def _requests() -> Iterator[list[int]]:
    """Yield the list of stops requested by SIGINT or SIGTERM, to be looked at.

    The first signal restores the handlers, so that a second one has its usual effect.
    Signals that have a handler already, as in a notebook or under a launcher, and those
    of other threads, where none can be installed, are left alone.
    """
    requested: list[int] = []
    usual = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
    }
    taken = {
        number: handler
        for number, handler in usual.items()
        # Python installs handlers from the main thread only.
        if threading.current_thread() is threading.main_thread()
        # Another handler is the launcher's or the notebook's, which knows better.
        and signal.getsignal(number) == handler
    }

    def restore() -> None:
        for number, handler in taken.items():
            signal.signal(number, handler)

    def request(number: int, frame: FrameType | None) -> None:
        del frame
        requested.append(number)
        restore()

    for number in taken:
        signal.signal(number, request)
    try:
        yield requested
    finally:
        restore()


def open_log(path: Path, *, resumed_at: int) -> Path:
    """Return the path of a log without the lines after a step; damaged ones go.

    Args:
        path: of the log, JSON lines; created if it does not exist.
        resumed_at: step at which the run is resumed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()

    def kept(line: dict[str, Any]) -> bool:
        # A line without a number belongs to no step.
        return isinstance(line["step"], int | float) and line["step"] <= resumed_at

    truncate_jsonl(path, kept, keys=("step",))
    return path


def append(path: Path, record: dict[str, float], *, steps: int) -> None:
    """Append one record to a log, and print its losses when they are validated.

    Args:
        path: of the log.
        record: must have `step`.
        steps: of the whole run.

    Raises:
        OSError: the line cannot be written.
    """
    step = int(record["step"])
    try:
        # Opened for each line: whatever ends the process, whole lines are on disk.
        with path.open("a") as file:
            file.write(json.dumps(record) + "\n")
    except OSError as reason:
        raise OSError(
            f"{path.parent}: step {step} was not logged "
            f"({reason.strerror}); {RESUME_HINT}"
        ) from reason
    if "validation_loss" in record:
        losses = (f"{name} {record[name]:.3g}" for name in ("loss", "validation_loss"))
        line = f"training {step} / {steps}  {' '.join(losses)}"
        print(line, file=sys.stderr, flush=True)
