"""The law that a data set in path coordinates is driven with: derived once, kept beside it."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax

from sfkd_jax import artefacts, assembly, shelf
from sfkd_jax.control import PathLaw, law_arrays, law_from_arrays
from sfkd_jax.vehicle import Vehicle


def ensure(settings: dict[str, Any]) -> PathLaw | None:
    """The law, derived now if it does not lie on the shelf; None for data sets of other frames."""
    if not shelf.is_along_path(settings):
        return None
    if not artefacts.exists(shelf.law_path(settings)):
        plant = assembly.build_vehicle(settings["vehicle"])
        shelf.say(f"deriving the law of vehicle {plant.name}")
        law = jax.jit(partial(assembly.build_law, settings["dataset"], plant))()
        shelf.write_law(settings, law_arrays(law))
    return law_from_arrays(shelf.read_law(settings))


def loop(settings: dict[str, Any]) -> Vehicle:
    """The vehicle with that law closed around it: states and controls of `path_frame`.

    Raises:
        ValueError: the data set is not in path coordinates.
    """
    law = ensure(settings)
    if law is None:
        raise ValueError("a loop along a path needs dataset=path")
    return assembly.build_loop(assembly.build_vehicle(settings["vehicle"]), law)
