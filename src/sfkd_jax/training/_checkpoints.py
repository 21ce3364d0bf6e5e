"""Latest and best training states on disk, through orbax."""

from __future__ import annotations

import logging
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as managers

from sfkd_jax.store import one_line


class Checkpoints:
    """A directory that holds the latest and the best training state.

    A save is atomic: a process killed in the middle leaves the previous states.
    """

    def __init__(self, directory: Path) -> None:
        """Open a directory, which is created if it does not exist."""

        def score(metrics: dict[str, float]) -> float:
            return metrics["validation_loss"]

        # The best state is the result; a resumed run starts from the latest one.
        best = managers.BestN(get_metric_fn=score, reverse=True, n=1)
        kept = managers.AnyPreservationPolicy([managers.LatestN(1), best])
        options = ocp.CheckpointManagerOptions(
            preservation_policy=kept,
            best_fn=score,
            best_mode="min",
            # A process that was killed while it saved leaves such directories.
            cleanup_tmp_directories=True,
            # Once `save` returns, a signal may end the process.
            enable_async_checkpointing=False,
        )
        # The path is absolute, since a command may change its working directory.
        self._manager = ocp.CheckpointManager(directory.resolve(), options=options)

    def save(self, step: int, state: Any, validation_loss: float) -> None:
        """Write the state after `step` optimiser steps, or raise an OSError."""
        metrics = {"validation_loss": float(validation_loss)}
        logger = logging.getLogger("absl")
        level = logger.level
        logger.setLevel(logging.CRITICAL)  # orbax logs a traceback and raises as well
        try:
            self._manager.save(step, args=ocp.args.StandardSave(state), metrics=metrics)
        except Exception as reason:  # orbax raises any error of its storage
            # The last clause says what happened; the ones before name internals.
            line = one_line(str(reason).rsplit(": ", 1)[-1])
            raise OSError(
                f"{self._manager.directory}: step {step} was not saved ({line}); "
                "the same command goes on from the last checkpoint"
            ) from reason
        finally:
            logger.setLevel(level)

    def latest_step(self) -> int | None:
        """Return the step of the newest state, or None."""
        return self._manager.latest_step()

    def best_step(self) -> int | None:
        """Return the step with the lowest validation loss, or None."""
        return self._manager.best_step()

    def resume(self, like: Any) -> Any:
        """Return the newest state, or `like` if there is no state."""
        step = self.latest_step()
        if step is None:
            return like
        # After an error, every array that orbax has not read yet prints a traceback.
        with redirect_stderr(StringIO()):
            try:
                return self.restore(step, like)
            except Exception as reason:  # orbax raises any error of its storage
                line = one_line(str(reason) or type(reason).__name__)
                raise OSError(
                    f"{self._manager.directory}/{step} cannot be read ({line}); "
                    "remove it to go on from the checkpoint before"
                ) from reason

    def restore(self, step: int, like: Any) -> Any:
        """Return the state saved at `step`, with the structure and types of `like`."""
        # With the shapes and types of `like`, a restored state fits the compiled step.
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        state = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
        # Orbax commits the state to a device, with which all would be compiled again.
        return jax.tree.map(jnp.asarray, jax.device_get(state))

    def close(self) -> None:
        """Release the directory."""
        self._manager.close()
