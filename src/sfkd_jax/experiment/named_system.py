"""A system that the settings of a command name: certified, and compared."""

from __future__ import annotations

import inspect
import time
from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.experiment.options import Settings
from sfkd_jax.experiment.system_runs import compare_system
from sfkd_jax.experiment.systems import certify_system
from sfkd_jax.ranges import imported
from sfkd_jax.systems import System, Tracking

COMPARED = 8
"""Number of runs in which controllers are compared."""


def train_system(settings: Settings) -> dict[str, Any]:
    """Certify the system that the settings of a command name, and compare it.

    Args:
        settings: of the command; `system` is package.module:function, which returns a
            `System` and a `Tracking`.

    Raises:
        ValueError: the function does not return these.
    """
    began = time.perf_counter()
    make = imported(str(settings.system), "system")
    if not callable(make) or inspect.signature(make).parameters:
        raise ValueError(f"system={settings.system} must be a function of no arguments")
    made: Any = make()
    is_pair = isinstance(made, tuple) and len(made) == 2
    if not (is_pair and isinstance(made[0], System) and isinstance(made[1], Tracking)):
        raise ValueError(
            f"system={settings.system} must return a System and what it follows, as "
            f"sfkd_jax.tracking returns it; got {type(made).__name__}"
        )
    system, frame = made
    directory = Path(settings.root) / settings.name
    certified = certify_system(
        system, frame, root=directory, seed=settings.seed, **vars(settings.tubes)
    )
    store.print_message(str(certified))
    compared = compare_system(certified, system, runs=COMPARED)
    tubes = certified.certificate.tubes
    result = {
        "run": str(directory),
        "system": system.name,
        "states": len(system.states),
        "alpha": certified.certificate.proof.alpha,
        "outputs": {name: vars(bounds) for name, bounds in tubes.outputs.items()},
        "coverage": tubes.coverage.share,
        "coverage_ci95": list(tubes.coverage.ci95),
        **compared,
        "seconds": time.perf_counter() - began,
    }
    store.write_json(directory / "comparison.json", result)
    return result
