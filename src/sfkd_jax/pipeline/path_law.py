"""The law of a data set in path coordinates, and the generator of its drives."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from sfkd_jax import build, store
from sfkd_jax.control import PathLaw, law_from_arrays, law_to_arrays
from sfkd_jax.data import (
    generate,
    generate_along_path,
    generate_s3_along_path,
    generate_switching,
    segment_scenarios,
    segment_scenarios_along_path,
)
from sfkd_jax.pipeline import runs
from sfkd_jax.plants import Vehicle
from sfkd_jax.types import Key, Trajectory


def ensure_law(settings: dict[str, Any]) -> PathLaw | None:
    """Return the law of the data set; derive it if it is missing.

    Returns:
        The law, or None if the data set is not in path coordinates.
    """
    if not runs.is_along_path(settings):
        return None
    if not store.exists(runs.law_path(settings)):
        plant = build.build_vehicle(settings["vehicle"])
        store.print_message(f"deriving the law of vehicle {plant.name}")
        law = jax.jit(partial(build.build_law, settings["dataset"], plant))()
        runs.write_law(settings, law_to_arrays(law))
    return law_from_arrays(runs.read_law(settings))


def closed_loop(settings: dict[str, Any]) -> Vehicle:
    """Return the closed loop of vehicle and law, in the coordinates of `path_frame`.

    Raises:
        ValueError: the data set is not in path coordinates.
    """
    law = ensure_law(settings)
    if law is None:
        raise ValueError("a loop along a path needs dataset=path")
    return build.build_loop(build.build_vehicle(settings["vehicle"]), law)


def generator(
    settings: dict[str, Any], options: dict[str, Any], *, switching: bool = False
) -> Callable[[Key], Trajectory]:
    """Return key -> the drives of a data set, or as many under the switching of S3.

    Args:
        settings: of the run.
        options: of the generator, without the environment box.
        switching: whether the environment follows S3.
    """
    if not runs.is_along_path(settings):
        plant = build.build_vehicle(settings["vehicle"])
        return partial(
            generate_switching if switching else generate,
            plant,
            build.build_driver(plant),
            **options,
        )
    if switching:
        return partial(generate_s3_along_path, closed_loop(settings), **options)
    box = {name: tuple(settings["dataset"][name]) for name in ("env_low", "env_high")}
    return partial(generate_along_path, closed_loop(settings), **options, **box)


def generated_scenarios(settings: dict[str, Any]) -> Int[np.ndarray, " segment"]:
    """Return the scenario of every segment of `generator`, as index into SCENARIOS."""
    of_segments = (
        segment_scenarios_along_path
        if runs.is_along_path(settings)
        else segment_scenarios
    )
    return of_segments(settings["dataset"]["segments"])
