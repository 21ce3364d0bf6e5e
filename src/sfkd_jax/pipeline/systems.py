"""The systems that an evaluation compares."""

from __future__ import annotations

from typing import Any

from sfkd_jax import build, policy, store
from sfkd_jax.pipeline import path_law, runs, stages
from sfkd_jax.plants import Vehicle


def load_systems(settings: dict[str, Any], plant: Vehicle) -> dict[str, build.System]:
    """Return the systems of `evaluation.systems` by name.

    "self" is the policy of the run, which is trained if it is missing. With
    `env_source=estimated` every system that reads e estimates it.

    Args:
        settings: of the run.
        plant: the true vehicle.

    Raises:
        ValueError: an unknown system.
    """
    references = build.reference_systems(plant, path_law.ensure_law(settings))
    if settings["env_source"] == "estimated":
        references = {
            name: system
            if system.env_source == "none"
            else system._replace(env_source="estimated")
            for name, system in references.items()
        }
    systems = {}
    for name in settings["evaluation"]["systems"]:
        if name == "self":
            systems[settings["model"]["system"]] = policy_system(settings)
        else:
            systems[name] = build.choose(
                references | {"self": None}, name, "evaluation.systems entry"
            )
    return systems


def policy_system(settings: dict[str, Any]) -> build.System:
    """Return the policy of the run as a system, with a certificate if it has one."""
    trained = stages.ensure_policy(settings)
    certificate, reason = policy.read_certificate(runs.run_directory(settings), trained)
    if certificate is None:
        store.print_message(f"nothing is certified: {reason}")
    reads_env = trained.settings["model"]["environment"]
    env_source = settings["env_source"] if reads_env else "none"
    return build.System(
        trained.model, trained.params, env_source, certificate, trained.law
    )
