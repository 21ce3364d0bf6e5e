"""What drives a data set: the law of path coordinates, derived once and kept beside it, or the simple driver."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from sfkd_jax import artefacts, build
from sfkd_jax.control import PathLaw, law_to_arrays, law_from_arrays
from sfkd_jax.datasets import (
    generate,
    generate_along_path,
    generate_s3_along_path,
    generate_switching,
    segment_scenarios,
    segment_scenarios_along_path,
)
from sfkd_jax.pipeline import store
from sfkd_jax.types import Key, Trajectory
from sfkd_jax.vehicle import Vehicle


def ensure(settings: dict[str, Any]) -> PathLaw | None:
    """The law, derived now if it does not lie on the shelf; None for data sets of other frames."""
    if not store.is_along_path(settings):
        return None
    if not artefacts.exists(store.law_path(settings)):
        plant = build.build_vehicle(settings["vehicle"])
        artefacts.print_message(f"deriving the law of vehicle {plant.name}")
        law = jax.jit(partial(build.build_law, settings["dataset"], plant))()
        store.write_law(settings, law_to_arrays(law))
    return law_from_arrays(store.read_law(settings))


def loop(settings: dict[str, Any]) -> Vehicle:
    """The vehicle with that law closed around it: states and controls of `path_frame`.

    Raises:
        ValueError: the data set is not in path coordinates.
    """
    law = ensure(settings)
    if law is None:
        raise ValueError("a loop along a path needs dataset=path")
    return build.build_loop(build.build_vehicle(settings["vehicle"]), law)


def scenarios(settings: dict[str, Any]) -> Int[np.ndarray, " segment"]:
    """The scenario of every segment that `drives` generates for training."""
    of_segments = (
        segment_scenarios_along_path
        if store.is_along_path(settings)
        else segment_scenarios
    )
    return of_segments(settings["dataset"]["segments"])


def drives(
    settings: dict[str, Any], options: dict[str, Any], *, switching: bool = False
) -> Callable[[Key], Trajectory]:
    """key -> the drives of a data set, or as many under S3's switching.

    Args:
        settings: of the run.
        options: of the generator, less the environment box.
        switching: whether the schedule is S3's.
    """
    if not store.is_along_path(settings):
        plant = build.build_vehicle(settings["vehicle"])
        return partial(
            generate_switching if switching else generate,
            plant,
            build.build_driver(plant),
            **options,
        )
    if switching:
        return partial(generate_s3_along_path, loop(settings), **options)
    box = {name: tuple(settings["dataset"][name]) for name in ("env_low", "env_high")}
    return partial(generate_along_path, loop(settings), **options, **box)
