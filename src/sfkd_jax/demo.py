"""Drive a policy that ships with the package; nothing is trained."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import build, evaluation, policy, store
from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.evaluation.metrics import text_table
from sfkd_jax.paper import animate
from sfkd_jax.pipeline import evaluate_system, grid, runs
from sfkd_jax.plants import Vehicle

SHIPPED = Path(__file__).with_name("pretrained")
"""vehicle, or vehicle_path in path coordinates -> policy.npz, its manifest and
certificate, as `train` wrote them.
"""
ALONG_PATH = "_path"
PRINTED = ("rmse_m", "max_deviation_m", "smoothness_rad_per_s", "violation.v0")
"""Metrics of the table."""


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Simulate a shipped policy beside nominal and oracle; print a table, animate.

    Raises:
        ArtefactError: the shipped policy was changed.
        ValueError: no policy ships for this vehicle or for these settings of it.
    """
    began = time.perf_counter()
    trained = _load_shipped(settings)
    settings = settings | {
        "name": "demo",
        "evaluation": settings["evaluation"] | settings["demo"],
    }
    plant = build.build_vehicle(settings["vehicle"])
    episodes = evaluate_system.make_episodes(settings, plant)
    directory = Path(settings["root"]) / settings["name"]
    results = directory / f"{episodes.name}_{_name(settings)}"
    with store.locked(results):
        rows = []
        for name, system in _systems(settings, plant, trained).items():
            store.print_message(
                f"driving {settings['demo']['episodes']} x "
                f"{settings['demo']['episode_s']:.0f} s: {name}"
            )
            evaluate = evaluate_system.compile_system(
                settings, plant, name, system, None
            )
            path, result = results / name, evaluate(episodes)
            rows.append(grid.write_cell(path, settings, episodes, result))
        rows = evaluation.compare(rows)
        document = {"rows": rows, "config": settings, "versions": store.versions()}
        store.write_json(results / "results.json", document)
        for line in text_table(rows, *PRINTED):
            store.print_message(line)
        film = animate(directory, rows, episodes.name, corridor=_half_width(trained))
    store.print_message(
        f"animation: {film}; {time.perf_counter() - began:.0f} s in all"
    )
    return {
        "animation": film and str(film),
        "rows": len(rows),
        "results": str(results / "results.json"),
    }


def _name(settings: dict[str, Any]) -> str:
    """Return the name of the shipped policy for these settings."""
    return settings["vehicle"]["name"] + ALONG_PATH * runs.is_along_path(settings)


def _systems(
    settings: dict[str, Any], plant: Vehicle, trained: policy.Policy
) -> dict[str, build.System]:
    """Return the policy and the two references that it is compared with."""
    references = build.reference_systems(plant, trained.law)
    own = build.System(
        trained.model,
        trained.params,
        settings["env_source"],
        trained.certificate,
        trained.law,
    )
    return {
        trained.settings["model"]["system"]: own,
        "nominal": references["nominal"],
        "oracle": references["oracle"],
    }


def _load_shipped(settings: dict[str, Any]) -> policy.Policy:
    """Return the policy for a vehicle, with its verified certificate."""
    if settings["env_source"] == "none":
        raise ValueError(
            "the controllers that ship read the environment; "
            "choose env_source=measured or env_source=estimated"
        )
    name = _name(settings)
    shipped = sorted(entry.name for entry in SHIPPED.iterdir() if entry.is_dir())
    began = time.perf_counter()
    trained = (
        policy.load(SHIPPED / name, controller=settings["controller"])
        if name in shipped
        else None
    )
    if trained is None or trained.settings["vehicle"] != settings["vehicle"]:
        known = " and ".join(one for one in shipped if not one.endswith(ALONG_PATH))
        raise ValueError(
            f"controllers ship for {known} as they are; for another vehicle run train"
        )
    if trained.certificate is None:
        raise store.ArtefactError(
            f"{SHIPPED / name} was changed: its certificate is about other weights"
        )
    alpha, seconds = trained.certificate["alpha"], time.perf_counter() - began
    store.print_message(
        f"certificate: holds, alpha {alpha:.4f}; loaded and verified in {seconds:.1f} s"
    )
    if half := _half_width(trained):
        share = 100 * trained.certificate["corridor"]["level"]
        store.print_message(
            f"corridor: {half:.2f} m to each side, "
            f"on {share:.0f} % of the drives of its class"
        )
    return trained


def _half_width(trained: policy.Policy) -> float | None:
    """Return the half width of the certified corridor [m], if there is one."""
    return (trained.certificate or {}).get("corridor", {}).get("corridor_m")


if __name__ == "__main__":
    hydra_command(run)()
