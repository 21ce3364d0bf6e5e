"""Checks of the settings that are stored with a policy, before it is built."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.assembly._vehicles import FROM_OUTSIDE
from sfkd_jax.driving import plants
from sfkd_jax.driving.path_coordinates import PATH_SPEED
from sfkd_jax.settings import Values


def check_imported(settings: Any) -> None:
    """Check that the code that stored settings name was imported by the caller.

    Raises:
        ValueError: its module is not imported, or is one of the standard library, whose
            modules are always imported and hold no models.
    """
    model = settings.get("model") if isinstance(settings, Mapping) else None
    factory = model.get("factory") if isinstance(model, Mapping) else None
    if factory is None:
        return
    module = str(factory).partition(":")[0]
    # A stored name must not reach os.system: Python's own modules are always loaded.
    if module.partition(".")[0] in sys.stdlib_module_names:
        raise ValueError(f"its model is {factory}, which is no model but Python's own")
    if module not in sys.modules:
        raise ValueError(
            f"its model is {factory}: import {module} first, if you trust it"
        )


def check_consistent(
    settings: Values, vehicle: plants.Vehicle, law: Mapping[str, Any] | None
) -> None:
    """Check that the settings of a policy contradict neither each other nor its law.

    Args:
        settings: as they are stored.
        vehicle: that they describe.
        law: the law of a policy along a path, as tables of numpy; None in the world.

    Raises:
        ValueError: they contradict each other.
    """
    space = settings["space"]
    for name, values in space.items():
        # No channel has a smaller scale: one that never moves has 1.
        least = 1e-6 if name.endswith("scale") else -math.inf
        if not all(least < value < math.inf for value in values):
            raise ValueError(f"its space.{name} = {values} is out of range")
    if law is not None:
        _check_law_tables(settings, law)
        law_settings = settings.get("dataset", {}).get("law")
        # Of a law from elsewhere nothing more is known.
        if law_settings is not None:
            _check_law_settings(settings, vehicle, law, law_settings)
    elif "segments" in settings.get("dataset", {}):
        # Simulated runs never stop: a mean step is about as long as at the centre of v.
        length = space["body_mean"][0] * vehicle.dt
        if not 0.5 < space["increment_mean"][0] / length < 2.0:
            raise ValueError(f"its vehicle.dt = {vehicle.dt} is not that of its data")


def _check_law_tables(settings: Values, law: Mapping[str, Any]) -> None:
    """Raise a ValueError unless the tables of a law are on one grid with wide axes."""
    space = settings["space"]
    body = len(space["body_mean"])
    # Lateral acceleration and speed, then the entries of e.
    axes = 2 + len(space["env_mean"])
    grid = law["control"].shape[:-1]
    expected = {
        "low": (axes,),
        "high": (axes,),
        "perturbation": (2,),
        "state": (*grid, body),
        "control": (*grid, 2),
        "gain": (*grid, 2, body),
    }
    shapes = {name: table.shape for name, table in law.items()}
    if shapes != expected or len(grid) != axes or min(grid) < 2:
        raise ValueError(f"its law has tables of shapes {shapes}, not of one grid")
    if (law["low"] >= law["high"]).any() or (law["perturbation"] <= 0).any():
        raise ValueError("its law has an axis without width, or no perturbation")


def _check_law_settings(
    settings: Values,
    vehicle: plants.Vehicle,
    law: Mapping[str, Any],
    law_settings: Values,
) -> None:
    """Raise a ValueError unless a law has the axes and the period of its settings."""
    box = settings["environment"]
    side = law_settings["lateral_acceleration"]
    slow, fast = law_settings["speed"]
    expected = {
        "low": (-side, slow, *box["low"]),
        "high": (side, fast, *box["high"]),
        "perturbation": law_settings["perturbation"],
    }
    for name, values in expected.items():
        if not np.allclose(law[name], values, rtol=1e-6, atol=0.0):
            raise ValueError(f"its law has {name} {law[name]}, its settings {values}")
    # The second control of a vehicle from outside may be anything.
    if settings["vehicle"]["name"] in FROM_OUTSIDE or vehicle.speed_loop:
        return
    # The speed is the integral of the acceleration, so that the linear regulator has a
    # gain in closed form, which tells the sampling period.
    dt = vehicle.dt
    weight = law_settings["velocity"]
    effort = law_settings["drive"]
    cost = 0.5 * (weight + math.sqrt(weight**2 + 4.0 * weight * effort / dt**2))
    middle = law["gain"].shape[0] // 2
    gain = float(law["gain"][middle, ..., 1, PATH_SPEED].mean())
    if not 0.95 < gain * (effort + dt**2 * cost) / (dt * cost) < 1.05:
        raise ValueError(f"its vehicle.dt = {dt} is not that of its law")
