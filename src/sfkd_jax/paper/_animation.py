"""Animations of the rows of a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.paper._drives import Drive, drives
from sfkd_jax.reporting.film import SECONDS, Car, Film, write_film
from sfkd_jax.reporting.rows import NO_MODEL, vehicle_stem
from sfkd_jax.reporting.style import (
    ACCENT,
    DEPARTED,
    THIRD,
    family,
    line,
    rank,
    scenario_label,
)


def draw_film(
    path: Path, cars: dict[str, tuple[np.ndarray, np.ndarray]], **road: Any
) -> Path:
    """Write a GIF of up to three drives of one road.

    Args:
        path: of the GIF.
        cars: name -> signed deviation of x_1 … x_T [m], and x_0 … x_T.
        road: title, dt, points, envs and corridor, as in `Film`.
    """
    drives = zip(cars.items(), (ACCENT, THIRD, DEPARTED), strict=False)
    drawn = [Car(name, colour, *arrays) for (name, arrays), colour in drives]
    return write_film(Film(cars=drawn, **road), path)


def animate(
    directory: Path, rows: list[Row], scenario: str, *, corridor: float | None = None
) -> Path | None:
    """Write `scenario`_`vehicle`.gif beside the arrays of rows.

    Args:
        directory: of the arrays of the rows, and of the file.
        rows: of one vehicle.
        scenario: to show.
        corridor: certified half width [m].

    Returns:
        The file; None if no row has states and a path.
    """
    shown = [row for row in rows if str(row.get("scenario")) == scenario]
    shown.sort(key=lambda row: (rank(family(str(row.get("system")))), str(row["env"])))
    path = directory / f"{scenario}_{vehicle_stem(rows[0])}.gif"
    written = film(directory, shown, path, corridor=corridor)
    return written and written[0]


def film(
    directory: Path,
    rows: list[Row],
    path: Path,
    *,
    seconds: float = SECONDS,
    corridor: float | None = None,
) -> tuple[Path, list[str]] | None:
    """Write a GIF of SFKD, nominal and one other learned system.

    Args:
        directory: of the arrays of the rows.
        rows: on one scenario.
        path: of the GIF.
        seconds: of the episode to show.
        corridor: certified half width [m].

    Returns:
        The file and the names of the cars; None if no row has states and a path.
    """
    chosen = _choose(drives(directory, rows)[0])
    if not chosen:
        return None
    cars = [
        Car(one.name, line(one.system)["color"], one.lateral, np.asarray(one.states))
        for one in chosen
    ]
    first = chosen[0]
    title = scenario_label(str(first.row.get("scenario")))
    road = Film(title, first.dt, np.asarray(first.path), first.envs, cars, corridor)
    return write_film(road, path, seconds), [car.name for car in cars]


def _choose(available: list[Drive]) -> list[Drive]:
    """SFKD, nominal and one learned rival: ICODE-MPPI, or else the first one."""
    whole = [
        one for one in available if one.states is not None and one.path is not None
    ]
    rivals = [
        one
        for one in whole
        if not one.system.startswith("sfkd") and one.system not in NO_MODEL
    ]
    rivals.sort(
        key=lambda one: (one.system != "icode_mppi", one.row.get("env") != "measured")
    )
    named = [
        [one for one in whole if one.system == name] for name in ("sfkd", "nominal")
    ]
    return [group[0] for group in (*named, rivals) if group] or whole[:1]
