"""The training loop: deterministic, resumable, stopped by a non-finite loss."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from sfkd_jax import store
from sfkd_jax.progress import Progress
from sfkd_jax.ranges import Positive
from sfkd_jax.training._checkpoints import Checkpoints
from sfkd_jax.training._losses import Loss
from sfkd_jax.types import Key, Model, Params, Trajectory

Draw: TypeAlias = Callable[[Trajectory, Key], Trajectory]
"""(training trajectories, key) -> a batch of windows."""
Callback: TypeAlias = Callable[[int, Mapping[str, float]], None]
"""(step, metrics) -> nothing: what is told of a training, such as a logger."""
WARM_UP = 100
"""Steps until the largest learning rate, in all but short runs."""
LOG = "metrics.jsonl"
"""File of the losses, one JSON object a line."""
RECORD = "training.json"
"""File that tells one training from another."""
FIRST_LOSS = "loss before the first step"
"""Entry of that file."""
FINAL_RATE = 0.01
"""Last learning rate relative to the largest."""


class TrainingStopped(RuntimeError):
    """Training cannot continue; the message names the last checkpoint."""


class TrainState(NamedTuple):
    """The whole state of training; random keys are derived from `step`."""

    step: jax.Array
    params: Params
    optimizer: Any


def no_callback(step: int, metrics: Mapping[str, float]) -> None:
    """Tell nobody."""


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
    callback: Callback = no_callback,
) -> tuple[Params, int]:
    """Train and return the parameters with the lowest validation loss.

    The optimiser is Adam with linear warm-up and cosine decay. A training is resumed
    from its last checkpoint in `directory`; the checkpoints of another training are
    refused. Batches depend on the key and the step only, so a run that was interrupted
    ends bit-identical to one that was not.

    Args:
        model: to be trained. To train on from known parameters, pass a model whose
            `init` returns them: `model._replace(init=lambda key: params)`.
        loss: see `multi_step_loss`.
        draw: (data, key) -> a batch of windows.
        data: the training trajectories.
        held_out: windows of the validation loss.
        key: for the initial parameters and the batches.
        directory: for checkpoints/, metrics.jsonl, and training.json, which tells one
            training from another.
        steps: number of optimiser steps.
        learning_rate: the largest one.
        clip_norm: largest global norm of a gradient.
        log_every: number of steps in a compiled chunk and between lines of the log; it
            divides `steps`.
        save_every: number of steps between checkpoints, a multiple of `log_every`.
        callback: (step, metrics), called after every line of the log.

    Returns:
        The best parameters, and the step at which they were reached.

    Raises:
        TrainingStopped: the loss or a gradient is not finite.
    """
    _check_multiples(steps, save_every, log_every)
    # Batches have a key of their own, so that a resumed run draws the same ones.
    init_key, data_key = jax.random.split(key)
    transform, schedule = _optimizer(steps, learning_rate, clip_norm)
    # Compiled, since initialisers op by op take seconds for many small matrices.
    begin = jax.jit(partial(_begin, model, transform))
    training = _fingerprint(model, draw, data, key)
    training |= {"steps": steps, "learning_rate": learning_rate}
    training |= {"clip_norm": clip_norm, "save_every": save_every}

    # It stands for what no hash tells: loss, model and held-out data.
    def first_loss() -> float:
        return float(loss.validate(begin(init_key).params, held_out)[0])

    directory = Path(directory)
    log = directory / LOG
    # Closed after an error as well: the caller may open the directory again to resume.
    with ExitStack() as stack:
        kept = closing(Checkpoints(directory / "checkpoints"))
        checkpoints = stack.enter_context(kept)
        _claim(directory, training, first_loss, checkpoints.latest_step())
        state = checkpoints.resume(begin(init_key))
        start = int(state.step)
        _drop_lines_after(log, start)
        began = time.perf_counter()
        advance = _chunk(loss, transform, schedule, draw, length=log_every)
        progress = stack.enter_context(Progress("training", steps, start))
        for done in range(start + log_every, steps + 1, log_every):
            state, means = advance(state, data, data_key)
            record = {name: float(value) for name, value in means.items()}
            record |= {"step": done, "seconds": time.perf_counter() - began}
            saves = done % save_every == 0 or done == steps
            if saves:  # the validation loss is for the choice between saved states
                record.update(_validation(model, loss, state.params, held_out))
            _require_finite(record, checkpoints)
            # Before the checkpoint: a resumed run can drop lines, but not add them.
            _append(log, record)
            callback(done, record)
            if saves:
                checkpoints.save(done, state, record["validation_loss"])
            progress.advance(log_every, _losses(record) if saves else "")
        best = checkpoints.best_step() or steps
        return checkpoints.restore(best, state).params, best


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
    """Train as `fit` does, but in one program and without a directory.

    It is for trainings that take seconds.

    Args:
        params: initial parameters.
        loss: see `one_step_loss`.
        draw: (data, key) -> a batch of windows.
        data: the training trajectories.
        key: for the batches.
        steps: number of optimiser steps.
        learning_rate: the largest one.

    Returns:
        The parameters after the last step.
    """
    transform, schedule = _optimizer(steps, learning_rate, 100.0)
    advance = _chunk(loss, transform, schedule, draw, length=steps)
    start = TrainState(jnp.zeros((), jnp.int32), params, transform.init(params))
    after, _ = advance(start, data, key)
    return after.params


def _check_multiples(steps: int, save_every: int, log_every: int) -> None:
    """Raise a ValueError if chunks of `log_every` steps do not fit."""
    if save_every % log_every or steps % log_every:
        raise ValueError(
            "training.steps and save_every must be multiples of "
            f"log_every = {log_every}"
        )


def _fingerprint(
    model: Model, draw: Draw, data: Trajectory, key: Key
) -> dict[str, Any]:
    """Return what tells a training from another one, besides its settings."""
    return {
        "key": jax.random.key_data(key).tolist(),
        "data": store.sha256_of_arrays(data._asdict()),
        "windows": str(jax.eval_shape(draw, data, key)),
        "parameters": str(jax.eval_shape(model.init, key)),
    }


def _begin(model: Model, transform: Any, key: Key) -> TrainState:
    """Return the state before the first step."""
    params = model.init(key)
    return TrainState(jnp.zeros((), jnp.int32), params, transform.init(params))


def _claim(
    directory: Path,
    training: dict[str, Any],
    first_loss: Callable[[], float],
    latest: int | None,
) -> None:
    """Record a training beside its checkpoints, or refuse those of another one.

    Args:
        directory: of the training.
        training: what tells it from another one.
        first_loss: () -> loss before the first step, which does so as well.
        latest: step of the last checkpoint; None without one.
    """
    path = directory / RECORD
    if latest is None:
        # As text, because the loss may be no number that JSON knows.
        store.write_json(path, {**training, FIRST_LOSS: f"{first_loss():.6g}"})
        return
    recorded = dict(store.read_json(path)) if path.is_file() else {}
    before = float(recorded.pop(FIRST_LOSS, "nan"))
    changed = store.differences(recorded, training)
    if not changed:
        now = first_loss()
        # Another device rounds differently.
        if not math.isclose(before, now, rel_tol=1e-3):
            changed = [f"{FIRST_LOSS} was {before:.4g}, is now {now:.4g}"]
    if changed:
        raise ValueError(
            f"{directory} holds another training ({'; '.join(changed[:3])}); "
            "choose another directory, or remove its checkpoints"
        )
    steps = training["steps"]
    finished = ", finished" if latest >= steps else ""
    store.print_message(f"training {latest} / {steps}  resumed{finished}")


def _drop_lines_after(log: Path, last: int) -> None:
    """Drop the lines of steps after the last checkpoint, which are logged again."""

    def is_kept(line: dict[str, Any]) -> bool:
        return line["step"] in range(last + 1)

    store.truncate_jsonl(log, is_kept, keys=("step",))


def _validation(
    model: Model, loss: Loss, params: Params, held_out: Trajectory
) -> dict[str, float]:
    """Return the entries of the log about a state that is saved."""
    total, parts, _ = loss.validate(params, held_out)
    entries = {
        "validation_loss": float(total),
        "validation_prediction": float(parts["prediction"]),
    }
    rate = model.structure.rate
    if rate is not None:
        # The rate by construction; a certificate may prove less.
        entries["alpha"] = float(rate(params))
    return entries


def _require_finite(record: dict[str, float], checkpoints: Checkpoints) -> None:
    """Raise `TrainingStopped` if an entry of the log is not finite."""
    if not all(map(math.isfinite, record.values())):
        raise TrainingStopped(
            f"non-finite loss near step {record['step']}; the last good checkpoint "
            f"is step {checkpoints.latest_step()}"
        )


def _losses(record: dict[str, float]) -> str:
    """Return the losses of a record of the log, for a person."""
    return f"loss {record['loss']:.3g}, validation_loss {record['validation_loss']:.3g}"


def _append(path: Path, record: dict[str, float]) -> None:
    """Append one record to the log."""
    # The file is opened for each line, so that whole lines are on disk whatever ends
    # the process.
    with path.open("a") as file:
        file.write(json.dumps(record) + "\n")


def _optimizer(
    steps: int, learning_rate: float, clip_norm: float
) -> tuple[optax.GradientTransformation, optax.Schedule]:
    """Return Adam with linear warm-up and cosine decay, and its learning rates."""
    # A short run would end before its largest rate without a shorter warm-up.
    rise = min(WARM_UP, max(steps // 10, 1))
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, learning_rate, rise, max(steps, rise + 1), learning_rate * FINAL_RATE
    )
    # The gradient is clipped before Adam, or one batch with a huge gradient would spoil
    # its moments for long.
    clip = optax.clip_by_global_norm(clip_norm)
    # All parameters are one vector, which takes a few operations instead of a few for
    # each of many arrays.
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
            # The key depends on the step, so a resumed run draws the same batches.
            batch = draw(data, jax.random.fold_in(key, state.step))
            # Without the barrier every use of the batch would gather it again.
            batch = jax.lax.optimization_barrier(batch)
            (total, parts), grads = gradient(state.params, batch)
            updates, optimizer = transform.update(grads, state.optimizer, state.params)
            after = TrainState(
                step=state.step + 1,
                params=optax.apply_updates(state.params, updates),
                optimizer=optimizer,
            )
            return after, {
                "loss": total,
                "gradient_norm": optax.tree.norm(grads),
                **parts,
            }

        # Many steps are one program, since dispatching a step would take longer than
        # the step itself.
        state, records = jax.lax.scan(step, state, length=length)
        means = jax.tree.map(jnp.mean, records)
        learning_rate = jnp.asarray(schedule(state.step))
        return state, {**means, "learning_rate": learning_rate}

    return chunk
