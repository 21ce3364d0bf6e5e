"""Loggers of a training: libraries that draw its losses while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from sfkd_jax.training import Callback, no_callback

FOLDER = "logger"
"""Folder of the files of a logger, in the run directory."""


def logger(
    name: str | None, directory: Path, settings: Mapping[str, Any]
) -> AbstractContextManager[Callback]:
    """Return a context of a callback that passes the metrics of a training on.

    Args:
        name: of the library, in `LOGGERS`; None for no logger.
        directory: of the run, below which the files are.
        settings: of the run, which are logged beside the metrics.

    Raises:
        ValueError: there is no such logger, or its library is not installed.
    """
    if name is None:
        return nullcontext(no_callback)
    if name not in LOGGERS:
        known = ", ".join(LOGGERS)
        raise ValueError(f"training.logger must be one of {known}, got {name!r}")
    return LOGGERS[name](directory / FOLDER, settings)


@contextmanager
def _tensorboard(folder: Path, settings: Mapping[str, Any]) -> Iterator[Callback]:
    """Write event files, for `tensorboard --logdir`."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise _missing("tensorboard") from None
    with SummaryWriter(str(folder)) as writer:
        writer.add_text("settings", str(dict(settings)))

        def log(step: int, metrics: Mapping[str, float]) -> None:
            for name, value in metrics.items():
                writer.add_scalar(name, value, step)

        yield log


@contextmanager
def _wandb(folder: Path, settings: Mapping[str, Any]) -> Iterator[Callback]:
    """Log to Weights & Biases; offline with WANDB_MODE=offline."""
    try:
        import wandb
    except ImportError:
        raise _missing("wandb") from None
    folder.mkdir(parents=True, exist_ok=True)
    with wandb.init(
        project="sfkd_jax",
        name=folder.parent.as_posix(),
        dir=folder,
        config=dict(settings),
        # The messages of a command stay its own.
        settings=wandb.Settings(console="off"),
    ) as run:

        def log(step: int, metrics: Mapping[str, float]) -> None:
            run.log(dict(metrics), step=step)

        yield log


def _missing(name: str) -> ValueError:
    """Return the error that names the extra of a library."""
    return ValueError(
        f"training.logger={name} needs its library: pip install 'sfkd-jax[{name}]'"
    )


LOGGERS: dict[
    str, Callable[[Path, Mapping[str, Any]], AbstractContextManager[Callback]]
] = {"tensorboard": _tensorboard, "wandb": _wandb}
"""Name -> (folder, settings) -> a context of a callback."""
