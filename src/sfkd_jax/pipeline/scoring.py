"""Score episodes, and count where predictions leave what is claimed about them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, evaluation, store
from sfkd_jax.certification import conformal_tube, latent_tube
from sfkd_jax.control import PathLaw
from sfkd_jax.data import Dataset, to_path
from sfkd_jax.scenarios import Scenario
from sfkd_jax.types import Trajectory

OPEN_LOOP_STEPS = (1, 5, 10, 20)
Scorer: TypeAlias = Callable[
    [evaluation.Episode, Scenario], tuple[evaluation.Scores, dict[str, Any]]
]
"""(episodes, their scenarios) -> scores, and the rates of violations."""


def scorer(
    settings: dict[str, Any], system: build.System, dataset: Dataset | None, dt: float
) -> Scorer:
    """Return the function that scores a batch of episodes of one system.

    Args:
        settings: of the run.
        system: its parameters folded.
        dataset: for the conformal tube, or None for none.
        dt: sampling period [s].
    """
    length, horizon = settings["dataset"]["steps"], settings["certification"]["horizon"]
    predict = jax.jit(
        partial(evaluation.predictions, system.model, length=length, horizon=horizon)
    )
    convert = jax.jit(jax.vmap(partial(_model_coordinates, system.law)))
    claims = _claims(settings, system, dataset)

    def score(
        driven: evaluation.Episode, scenarios: Scenario
    ) -> tuple[evaluation.Scores, dict[str, Any]]:
        seen = Trajectory(driven.states, driven.controls, driven.assumed_envs)
        seen = convert(seen, scenarios)
        errors = None
        if seen.controls.shape[1] >= length:
            errors = jax.device_get(predict(system.params, seen))
        scores = evaluation.score(driven, np.asarray(scenarios.envs), dt=dt)
        return scores, evaluation.violations(errors, claims)

    return score


def _model_coordinates(
    law: PathLaw | None, driven: Trajectory, scenario: Scenario
) -> Trajectory:
    """An episode in the coordinates of the model: of the world, or of the path."""
    if law is None:
        return driven
    speeds = jnp.full(driven.controls.shape[0], scenario.speed)
    return to_path(driven, scenario.path, law, speeds)


def _claims(
    settings: dict[str, Any], system: build.System, dataset: Dataset | None
) -> evaluation.Claims:
    """Claims about a system's predictions, of its certificate and of calibration."""
    level, horizon = (settings["certification"][name] for name in ("level", "horizon"))
    claims = evaluation.Claims(
        level=level, threshold=settings["evaluation"]["threshold_m"]
    )
    if dataset is not None:
        try:
            tube = conformal_tube(
                system.model,
                system.params,
                validation=dataset.validation,
                calibration=dataset.calibration,
                level=level,
                horizon=horizon,
                stride=evaluation.STRIDE,
            )
            claims = claims._replace(conformal=tube)
        except ValueError as reason:
            store.print_message(f"  no conformal tube: {reason}")
    proof = system.certificate
    if proof is None:
        return claims
    if (len(proof["tube"]["latent"]), proof["d_bar"]["level"]) != (horizon, level):
        store.print_message(
            "  the certificate is of another horizon or level and is not compared"
        )
        return claims
    d_bar = proof["d_bar"]["value"]
    latent = latent_tube(proof["alpha"], d_bar, horizon)
    return claims._replace(
        certified=proof["tube"]["physical"], latent=latent, d_bar=d_bar
    )


def open_loop(
    settings: dict[str, Any], system: build.System, dataset: Dataset | None
) -> dict[str, float] | None:
    """Return the position RMSE of predictions on the test part, by steps ahead [m]."""
    if dataset is None:
        return None
    horizon = settings["certification"]["horizon"]
    errors = jax.jit(partial(evaluation.open_loop, system.model, horizon=horizon))(
        system.params, dataset.test
    )
    distance = np.hypot(*np.asarray(errors, dtype=np.float64).T[:2])
    return {
        str(step): float(distance[step - 1])
        for step in OPEN_LOOP_STEPS
        if step <= horizon
    }
