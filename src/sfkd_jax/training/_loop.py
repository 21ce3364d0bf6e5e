"""The training loop: deterministic, resumable, stopped by a non-finite loss."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from sfkd_jax import store
from sfkd_jax.ranges import Positive
from sfkd_jax.training._checkpoints import Checkpoints
from sfkd_jax.training._losses import Loss
from sfkd_jax.types import Key, Model, Params, Trajectory

Draw: TypeAlias = Callable[[Trajectory, Key], Trajectory]
WARM_UP = 100
"""Steps until the largest learning rate, in all but short runs."""
LOG = "metrics.jsonl"
"""File of the losses, one JSON object a line."""
RECORD = "training.json"
"""File that tells one training from another."""
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
    directory: str | Path,
    *,
    steps: int = 4000,
    learning_rate: Positive = 3e-3,
    clip_norm: Positive = 100.0,
    log_every: int = 50,
    save_every: int = 500,
) -> tuple[Params, int]:
    """Train and return the parameters with the lowest validation loss.

    Adam with linear warm-up and cosine decay. This training is resumed from its last
    checkpoint in `directory`, and another one is refused there. Batches depend on the
    key and the step only, so a run that was interrupted, however, ends bit-identical to
    one that was not.

    Args:
        model: to be trained. To train on from given parameters, a model whose `init`
            returns them: `model._replace(init=lambda key: params)`.
        loss: see `multi_step_loss`.
        draw: (data, key) -> a batch of windows.
        data: the training trajectories.
        held_out: windows of the validation loss.
        key: for the initial parameters and the batches.
        directory: for checkpoints/, metrics.jsonl, and training.json, which tells one
            training from another.
        steps: optimiser steps.
        learning_rate: the largest.
        clip_norm: largest global gradient norm.
        log_every: steps per compiled chunk and per log line, which divides `steps`.
        save_every: steps per checkpoint, a multiple of `log_every`.

    Returns:
        The best parameters, and the step at which they were reached.

    Raises:
        TrainingStopped: the loss or a gradient is not finite.
    """
    directory = Path(directory)
    if save_every % log_every or steps % log_every:
        raise ValueError(
            "training.steps and save_every must be multiples of "
            f"log_every = {log_every}"
        )
    # Batches have a stream of their own: a resumed run draws the same ones.
    init_key, data_key = jax.random.split(key)
    transform, schedule = _optimizer(steps, learning_rate, clip_norm)
    # Compiled, since initialisers op by op take seconds for many small matrices.
    begin = jax.jit(partial(_begin, model, transform))
    record = {
        "key": jax.random.key_data(key).tolist(),
        "data": store.sha256_of_arrays(data._asdict()),
        "windows": str(jax.eval_shape(draw, data, data_key)),
        "parameters": str(jax.eval_shape(model.init, init_key)),
        "steps": steps,
        "learning_rate": learning_rate,
        "clip_norm": clip_norm,
        "save_every": save_every,
    }

    # One number for what no hash of a function tells: loss, model, held-out data.
    def first_loss() -> float:
        return float(loss.validate(begin(init_key).params, held_out)[0])

    checkpoints = Checkpoints(directory / "checkpoints")
    log = directory / LOG
    try:
        _claim(directory, record, first_loss, checkpoints.latest_step())
        # Of a new run it is the state as it was.
        state = checkpoints.resume(begin(init_key))
        start = int(state.step)
        began = time.perf_counter()
        # Lines of steps after the checkpoint would be there twice.
        store.truncate_jsonl(
            log, lambda line: line["step"] in range(start + 1), keys=("step",)
        )
        advance = _chunk(loss, transform, schedule, draw, length=log_every)
        for done in range(start + log_every, steps + 1, log_every):
            state, means = advance(state, data, data_key)
            record = {name: float(value) for name, value in means.items()}
            record |= {"step": done, "seconds": time.perf_counter() - began}
            saves = done % save_every == 0 or done == steps
            # Only where a state is saved: it is there to choose between states.
            if saves:
                total, parts, _ = loss.validate(state.params, held_out)
                record["validation_loss"] = float(total)
                record["validation_prediction"] = float(parts["prediction"])
                # What the model promises; a certificate may prove less.
                if rate := model.structure.rate:
                    record["alpha"] = float(rate(state.params))
            if not all(map(math.isfinite, record.values())):
                raise TrainingStopped(
                    f"non-finite loss near step {done}; the last good checkpoint "
                    f"is step {checkpoints.latest_step()}"
                )
            # Before the checkpoint: a resumed run can drop lines, but not add them.
            _append(log, record, steps)
            if saves:
                checkpoints.save(done, state, record["validation_loss"])
        best = checkpoints.best_step() or steps
        return checkpoints.restore(best, state).params, best
    # Also after an error: the caller may open the directory again to resume.
    finally:
        checkpoints.close()


def descend(
    params: Params,
    loss: Loss,
    draw: Draw,
    data: Trajectory,
    key: Key,
    *,
    steps: int,
    learning_rate: Positive = 3e-3,
) -> Params:
    """Train for seconds, in one program and without a directory; else as `fit`.

    Args:
        params: where to start.
        loss: see `one_step_loss`.
        draw: (data, key) -> a batch of windows.
        data: the training trajectories.
        key: for the batches.
        steps: optimiser steps.
        learning_rate: the largest.
    """
    transform, schedule = _optimizer(steps, learning_rate, 100.0)
    advance = _chunk(loss, transform, schedule, draw, length=steps)
    start = TrainState(jnp.zeros((), jnp.int32), params, transform.init(params))
    return advance(start, data, key)[0].params


def _begin(model: Model, transform: Any, key: Key) -> TrainState:
    """The state before the first step."""
    params = model.init(key)
    return TrainState(jnp.zeros((), jnp.int32), params, transform.init(params))


def _claim(
    directory: Path,
    record: dict[str, Any],
    first_loss: Callable[[], float],
    latest: int | None,
) -> None:
    """Record a training beside its checkpoints, or refuse those of another one."""
    path = directory / RECORD
    loss = "loss before the first step"
    if latest is None:
        # As text: it may be no number that JSON knows.
        store.write_json(path, record | {loss: f"{first_loss():.6g}"})
        return
    recorded = dict(store.read_json(path)) if path.is_file() else {}
    before = float(recorded.pop(loss, "nan"))
    changed = store.differences(recorded, record)
    # Another device rounds differently.
    if not changed and not math.isclose(before, now := first_loss(), rel_tol=1e-3):
        changed = [f"{loss} was {before:.4g}, is now {now:.4g}"]
    if changed:
        raise ValueError(
            f"{directory} holds another training ({'; '.join(changed[:3])}); "
            "choose another directory, or remove its checkpoints"
        )
    finished = ", finished" if latest >= record["steps"] else ""
    store.print_message(f"training {latest} / {record['steps']}  resumed{finished}")


def _append(path: Path, record: dict[str, float], steps: int) -> None:
    """Append one record to the log, and print its losses when they are validated."""
    # Opened for each line: whatever ends the process, whole lines are on disk.
    with path.open("a") as file:
        file.write(json.dumps(record) + "\n")
    if "validation_loss" in record:
        losses = (f"{name} {record[name]:.3g}" for name in ("loss", "validation_loss"))
        store.print_message(f"training {record['step']} / {steps}  {' '.join(losses)}")


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
    # As one vector: a few operations, where each of many arrays would have its own.
    return optax.flatten(optax.chain(clip, optax.adam(schedule))), schedule


def _chunk(
    loss: Loss,
    transform: optax.GradientTransformation,
    schedule: optax.Schedule,
    draw: Draw,
    *,
    length: int,
) -> Callable[..., tuple[TrainState, dict[str, jax.Array]]]:
    """Compile `length` optimiser steps: (state, data, key) -> state, mean metrics."""
    gradient = jax.value_and_grad(loss, has_aux=True)

    # The key is an argument, so that trainings from other seeds share a program.
    @jax.jit
    def chunk(
        state: TrainState, data: Trajectory, key: Key
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            # From the step, not a carried key: a resumed run draws the same batches.
            batch = draw(data, jax.random.fold_in(key, state.step))
            # Or every use of it would gather it again.
            batch = jax.lax.optimization_barrier(batch)
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
        means = jax.tree.map(jnp.mean, records)
        return state, means | {"learning_rate": jnp.asarray(schedule(state.step))}

    return chunk
