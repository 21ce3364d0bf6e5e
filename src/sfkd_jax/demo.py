"""Drive a policy that ships with the package; nothing is trained."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import build, evaluation, policy, store
from sfkd_jax.experiment import data, evaluating, grid
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings
from sfkd_jax.plants import Vehicle
from sfkd_jax.report import film_of, of_rows, text_table
from sfkd_jax.settings import plain, replace

SHIPPED = Path(__file__).with_name("pretrained")
"""vehicle, or vehicle_path in path coordinates -> policy.safetensors, its manifest and
certificate, as `train` wrote them.
"""
ALONG_PATH = "_path"
PRINTED = ("rmse_m", "max_deviation_m", "smoothness_rad_per_s", "violation.v0")
"""Metrics of the table."""


def run(settings: Settings) -> dict[str, Any]:
    """Simulate a shipped policy beside nominal and oracle; print a table, animate.

    Raises:
        ArtefactError: the shipped policy was changed.
        ValueError: no policy ships for this vehicle or for these settings of it.
    """
    began = time.perf_counter()
    trained = _load_shipped(settings)
    about = settings.demo
    protocol = replace(settings.evaluation, **vars(about))
    settings = replace(settings, name="demo", evaluation=protocol)
    plant = build.build_vehicle(settings.vehicle)
    episodes = evaluating.make_episodes(settings, plant)
    directory = Path(settings.root) / settings.name
    results = directory / f"{episodes.name}_{_name(settings)}"
    with store.locked(results):
        rows = []
        for name, system in _systems(settings, plant, trained).items():
            store.print_message(
                f"driving {about.episodes} x {about.episode_s:.0f} s: {name}"
            )
            evaluate = evaluating.SystemEvaluation(settings, plant, name, system, None)
            result, path = evaluate(episodes), results / name
            rows.append(grid.write_cell(path, directory, settings, episodes, result))
        rows = evaluation.compare(rows)
        document = {
            "rows": rows,
            "config": plain(settings),
            "versions": store.versions(),
        }
        store.write_json(results / "results.json", document)
        store.print_message(text_table(rows, *PRINTED))
        path = directory / f"{results.name}.gif"
        film = film_of(path, of_rows(directory, rows), _half_width(trained))
    store.print_message(
        f"animation: {film}; {time.perf_counter() - began:.0f} s in all"
    )
    return {
        "animation": film and str(film),
        "rows": len(rows),
        "results": str(results / "results.json"),
    }


def _name(settings: Settings) -> str:
    """Return the name of the shipped policy for these settings."""
    return settings.vehicle.name + ALONG_PATH * bool(
        data.source_of(settings).along_path
    )


def _systems(
    settings: Settings, plant: Vehicle, trained: policy.Policy
) -> dict[str, build.System]:
    """Return the policy and the two references that it is compared with."""
    references = build.reference_systems(plant, trained.law)
    own = build.System(
        trained.model,
        trained.params,
        settings.environment.source,
        trained.certificate,
        trained.law,
    )
    return {
        trained.settings["model"]["system"]: own,
        "nominal": references["nominal"],
        "oracle": references["oracle"],
    }


def _load_shipped(settings: Settings) -> policy.Policy:
    """Return the policy for a vehicle, with its verified certificate."""
    if settings.environment.source == "none":
        raise ValueError(
            "the controllers that ship read the environment; "
            "choose environment=measured or environment=estimated"
        )
    name = _name(settings)
    shipped = sorted(entry.name for entry in SHIPPED.iterdir() if entry.is_dir())
    began = time.perf_counter()
    trained = (
        policy.load(SHIPPED / name, controller=plain(settings.controller))
        if name in shipped
        else None
    )
    if trained is None or trained.settings["vehicle"] != plain(settings.vehicle):
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
