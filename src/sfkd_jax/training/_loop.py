"""The training loop: deterministic, resumable, stopped by a non-finite loss."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from sfkd_jax.ranges import Positive
from sfkd_jax.training._checkpoints import Checkpoints
from sfkd_jax.training._interruption import Interrupted, Interruption
from sfkd_jax.training._log import TrainingLog
from sfkd_jax.training._losses import Loss
from sfkd_jax.training._optimizer import optimizer
from sfkd_jax.types import Key, Model, Params, Trajectory

Draw: TypeAlias = Callable[[Trajectory, Key], Trajectory]


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

    A run that `directory` contains is resumed. Batches depend on the key and the step
    only, so an interrupted run ends bit-identical to an uninterrupted one. SIGINT or
    SIGTERM saves the state of the last log line before it raises.

    Args:
        model: to be trained. To train on from given parameters, a model whose `init`
            returns them: `model._replace(init=lambda key: params)`.
        loss: (params, batch of windows) -> loss, parts.
        draw: (data, key) -> a batch of windows.
        data: the training trajectories.
        held_out: windows of the validation loss.
        key: for the initial parameters and the batches.
        directory: for checkpoints/, metrics.jsonl, tensorboard/.
        steps: optimiser steps.
        learning_rate: see `optimizer`.
        clip_norm: see `optimizer`.
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
    init_key, data_key = jax.random.split(key)
    transform, schedule = optimizer(
        steps=steps, learning_rate=learning_rate, clip_norm=clip_norm
    )
    params = jax.jit(model.init)(init_key)
    state = TrainState(jnp.zeros((), jnp.int32), params, transform.init(params))
    checkpoints = Checkpoints(directory / "checkpoints")
    try:
        state = checkpoints.resume(state)
        start, logged = int(state.step), state
        with (
            TrainingLog(directory, steps=steps, resumed_at=start) as log,
            Interruption() as interruption,
        ):
            advance = interruption.compiled(
                _chunk(loss, transform, draw, length=log_every), state, data, data_key
            )
            validate = interruption.compiled(jax.jit(loss), params, held_out)
            began = time.perf_counter()
            for done in range(start + log_every, steps + 1, log_every):
                state, record = interruption.ready(advance(state, data, data_key))
                record = {name: float(value) for name, value in record.items()}
                record |= _progress(done, schedule, began)
                saves = done % save_every == 0 or done == steps
                if saves:
                    total, parts = interruption.ready(validate(state.params, held_out))
                    record |= {
                        "validation_loss": float(total),
                        "validation_prediction": float(parts["prediction"]),
                    }
                    record |= inspect(state.params) if inspect else {}
                _require_finite(record, done, checkpoints)
                # Before the checkpoint: a resumed run can drop lines, but not add them.
                log.write(record)
                logged = state
                if saves:
                    checkpoints.save(
                        done, state, validation_loss=record["validation_loss"]
                    )
        best = checkpoints.best_step() or steps
        return checkpoints.restore(best, state).params, best
    except Interrupted:
        # Never selected as the best: an uninterrupted run does not have this state.
        if int(logged.step) > start:
            checkpoints.save(int(logged.step), logged, validation_loss=math.inf)
        raise
    finally:
        checkpoints.close()


def _progress(step: int, schedule: optax.Schedule, began: float) -> dict[str, Any]:
    """Step, learning rate and elapsed time for the log."""
    return {
        "step": step,
        "learning_rate": float(jnp.asarray(schedule(step))),
        "seconds": time.perf_counter() - began,
    }


def _require_finite(
    record: dict[str, float], step: int, checkpoints: Checkpoints
) -> None:
    """Raise TrainingStopped if any entry of a record is not finite."""
    if not all(math.isfinite(value) for value in record.values()):
        raise TrainingStopped(
            f"non-finite loss near step {step}; "
            f"the last good checkpoint is step {checkpoints.latest_step()}"
        )


def _chunk(
    loss: Loss,
    transform: optax.GradientTransformation,
    draw: Draw,
    *,
    length: int,
) -> Any:
    """Compile `length` optimiser steps: (state, data, key) -> state, mean metrics."""
    gradient = jax.value_and_grad(loss, has_aux=True)

    # Not donated: an interrupted run saves the state from which a chunk started. The
    # key is an argument, so that trainings from other seeds share a compiled program.
    @jax.jit
    def chunk(
        state: TrainState, data: Trajectory, key: Key
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
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

        state, records = jax.lax.scan(step, state, length=length)
        return state, jax.tree.map(jnp.mean, records)

    return chunk
