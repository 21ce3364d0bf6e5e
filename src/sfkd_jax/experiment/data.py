"""Simulated data sets, and the boxes and parts of any data set."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from sfkd_jax import assembly, store
from sfkd_jax.data import Dataset, split
from sfkd_jax.driving.drives import (
    SCENARIOS,
    check_on_path,
    generate,
    generate_along_path,
    segment_scenarios,
)
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.experiment.laws import without_faults
from sfkd_jax.experiment.options import DatasetSettings
from sfkd_jax.settings import arguments
from sfkd_jax.types import Key, Trajectory

SWITCHING_STREAM = 2
"""The stream of runs of S3, folded into the data set's seed. Simulation and split use 0
and 1, laws use 3 and 4.
"""
Drive: TypeAlias = Callable[[Key], Trajectory]
"""key -> the runs of a data set."""


def drive(
    plant: Vehicle,
    settings: DatasetSettings,
    box: dict[str, Any],
    *,
    switching: bool = False,
    **changes: int,
) -> Drive:
    """Return key -> the runs of a data set.

    Args:
        plant: that drives; along a path its closed loop with the law.
        settings: of the data set.
        box: the corners of E.
        switching: whether the runs are under the switching of S3, which training never
            uses.
        changes: other arguments of the generator, in place of those of the settings.
    """
    changes = {**changes, "held_out": switching}
    if along := settings.along_path:
        return partial(
            generate_along_path, plant, **{**along.options, **changes, **box}
        )
    options = {**arguments(settings, generate), **changes, **box}
    return partial(generate, plant, assembly.build_driver(plant), **options)


def simulate(
    drive: Drive,
    settings: DatasetSettings,
    box: dict[str, Any],
    *,
    simulator: bool,
) -> Dataset:
    """Simulate a data set.

    Args:
        drive: key -> its runs.
        settings: of the data set.
        box: the corners of E.
        simulator: whether the vehicle is one on the host, whose failed runs are
            dropped.
    """
    options: Any = settings
    # Two keys: other shares of the split leave the trajectories as they are.
    drive_key, split_key = jax.random.split(jax.random.key(settings.seed))
    store.print_message(f"generating {options.segments} segments")
    trajectories = jax.jit(drive)(drive_key)
    is_along_path = settings.along_path is not None
    labels = segment_scenarios(options.segments, along_path=is_along_path)
    trajectories, labels = without_faults(trajectories, labels, simulator=simulator)
    if is_along_path:
        check_on_path(trajectories)
    return split(
        trajectories,
        split_key,
        shares=settings.shares,
        scenarios=jnp.asarray(labels),
        **box,
    )


def by_scenario(dataset: Dataset) -> dict[str, Trajectory]:
    """Return the segments of the test part by scenario, of simulated data."""
    labels: Any = dataset.scenarios
    parts = {}
    for code, name in enumerate(SCENARIOS):
        chosen = labels["test"] == code
        if chosen.any():
            parts[name] = jax.tree.map(
                lambda leaf, chosen=chosen: leaf[chosen], dataset.test
            )
    return parts
