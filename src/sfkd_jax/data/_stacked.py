"""Read whole drives from npz arrays x, u and e."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from sfkd_jax.data._logs import UNKNOWN, Columns, Log, environment_columns

STACKED = ("x", "u", "e")
"""Arrays of shape (drive, time, entry); x has one moment more."""


def stacked_drives(
    source: str,
    arrays: dict[str, np.ndarray],
    columns: Columns,
    dt: float,
    needs_environment: bool,
) -> list[Log]:
    """Return the drives of arrays x, u and e.

    Args:
        source: the file.
        arrays: of the file.
        columns: for the number of states and environments, and the name of the time.
        dt: between rows, if there is no time [s].
        needs_environment: whether e must be there.

    Raises:
        ValueError: arrays of other shapes, or that are no numbers.
    """
    has_environment = environment_columns(
        source,
        columns._replace(environment=("e",)),
        set(arrays),
        needs_environment,
    )
    wanted = {
        name: arrays[name] for name in STACKED if name in ("x", "u") or has_environment
    }
    wanted = {
        name: array[None] if array.ndim == 2 else array
        for name, array in wanted.items()
    }
    drives, steps = _check_shapes(source, wanted, columns)
    time = _time(source, arrays, columns.time, dt, (drives, steps + 1))
    x, u = (np.asarray(wanted[name], dtype=np.float64) for name in ("x", "u"))
    e = np.zeros((drives, steps, UNKNOWN))
    if has_environment:
        e = np.asarray(wanted["e"], dtype=np.float64)
    # u and e of the last moment are unknown and never used.
    u, e = (np.concatenate([part, part[:, -1:]], axis=1) for part in (u, e))
    rows, stretch = np.arange(steps + 1), np.zeros(steps + 1, dtype=int)
    return [
        Log(f"{source}, drive {k}", rows, "row", time[k], x[k], u[k], e[k], stretch)
        for k in range(drives)
    ]


def _check_shapes(
    source: str, wanted: dict[str, np.ndarray], columns: Columns
) -> tuple[int, int]:
    """The number of drives and steps; refuse arrays whose shapes do not agree."""
    for name, array in wanted.items():
        if array.ndim != 3 or array.dtype.kind not in "iuf":
            raise ValueError(
                f"{source}: {name} must be numbers of shape (drive, time, entry), "
                f"got {array.shape}"
            )
    drives, steps = wanted["x"].shape[0], wanted["x"].shape[1] - 1
    sizes = {
        "x": len(columns.state),
        "u": 2,
        "e": len(columns.environment) or wanted.get("e", np.zeros(1)).shape[-1],
    }
    for name, array in wanted.items():
        expected = (drives, steps + 1 if name == "x" else steps, sizes[name])
        if array.shape != expected:
            raise ValueError(
                f"{source}: {name} has shape {array.shape}, expected {expected}"
            )
    if steps < 1 or not drives:
        raise ValueError(f"{source}: no steps in x of shape {wanted['x'].shape}")
    return drives, steps


def _time(
    source: str,
    arrays: dict[str, np.ndarray],
    name: str,
    dt: float,
    shape: tuple[int, int],
) -> Float[np.ndarray, "drive time"]:
    """The time of every row: from the file, or dt apart."""
    time = arrays[name] if name in arrays else dt * np.arange(shape[1])
    if time.dtype.kind not in "iuf":
        raise ValueError(f"{source}: {name} must be numbers, got {time.dtype}")
    time = time.astype(np.float64)
    if time.shape not in ((shape[1],), shape):
        raise ValueError(f"{source}: {name} has shape {time.shape}, expected {shape}")
    return np.broadcast_to(time, shape)
