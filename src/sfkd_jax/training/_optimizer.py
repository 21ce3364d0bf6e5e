"""The optimiser: Adam with warm-up, cosine decay and gradient clipping."""

from __future__ import annotations

import optax


def optimizer(
    *,
    steps: int,
    learning_rate: float = 3e-3,
    warmup: int = 100,
    final: float = 0.01,
    clip_norm: float = 100.0,
) -> tuple[optax.GradientTransformation, optax.Schedule]:
    """Return Adam with linear warm-up and cosine decay, and its learning rate schedule.

    Args:
        steps: of the whole run.
        learning_rate: at the peak.
        warmup: steps until the peak.
        final: last learning rate, relative to the peak.
        clip_norm: largest global gradient norm.
    """
    rise = min(warmup, max(steps // 10, 1))
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, learning_rate, rise, max(steps, rise + 1), learning_rate * final
    )
    return optax.chain(
        optax.clip_by_global_norm(clip_norm), optax.adam(schedule)
    ), schedule
