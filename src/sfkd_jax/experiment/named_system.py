"""A system that the settings of a command name: certified, and compared."""

from __future__ import annotations

import inspect
import time
from typing import Any

from sfkd_jax import store
from sfkd_jax.experiment.run import Run
from sfkd_jax.experiment.system_runs import compared, drive_beside_rivals, first_run
from sfkd_jax.experiment.systems import certify_system
from sfkd_jax.ranges import imported
from sfkd_jax.report.system import COMPARISON, FIRST_RUN, write_system_report
from sfkd_jax.systems import System, Tracking

COMPARED = 8
"""Number of runs in which controllers are compared."""


def train_system(run: Run) -> dict[str, Any]:
    """Certify the system that the settings of a command name, compare it, and report.

    Args:
        run: of the command; `settings.system` is package.module:function, and returns
            a `System` and a `Tracking`.

    Raises:
        ValueError: the function does not return these.
    """
    began = time.perf_counter()
    settings = run.settings
    directory = run.directory
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
    certified = certify_system(
        system, frame, root=directory, seed=settings.seed, **vars(settings.tubes)
    )
    store.print_message(str(certified))
    driven = drive_beside_rivals(certified, system, runs=COMPARED)
    tubes = certified.certificate.tubes
    result = {
        "run": str(directory),
        "system": system.name,
        "states": len(system.states),
        "alpha": certified.certificate.proof.alpha,
        "outputs": {name: vars(bounds) for name, bounds in tubes.outputs.items()},
        "coverage": tubes.coverage.share,
        "coverage_ci95": list(tubes.coverage.ci95),
        **compared(driven),
        "seconds": time.perf_counter() - began,
    }
    store.write_json(directory / COMPARISON, result)
    store.write_json(directory / FIRST_RUN, first_run(certified, driven))
    page = write_system_report(directory)
    store.print_message(f"report: {page['report']}")
    return {**result, **page}
