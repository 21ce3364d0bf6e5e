"""Drive a policy that ships with the package; nothing is trained."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import artefacts, build, evaluation, policy
from sfkd_jax.cli.entry import hydra_command
from sfkd_jax.pipeline import evaluate_system, grid, store
from sfkd_jax.paper import animate

SHIPPED = Path(__file__).with_name("pretrained")
"""vehicle, or vehicle_path in path coordinates -> policy.npz, its manifest and
certificate, as `train` left them.
"""
ALONG_PATH = "_path"


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Check the certificate, drive, print a table, draw an animation.

    Raises:
        ArtefactError: what ships was changed.
        ValueError: a vehicle for which nothing ships, also by its settings.
    """
    began = time.perf_counter()
    trained = _shipped(settings)
    settings = settings | {
        "name": "demo",
        "evaluation": settings["evaluation"] | settings["demo"],
    }
    plant = build.build_vehicle(settings["vehicle"])
    track = evaluate_system.make_episodes(settings, plant)
    own = build.System(
        trained.model,
        trained.params,
        settings["env_source"],
        trained.certificate,
        trained.law,
    )
    systems = {trained.settings["model"]["system"]: own}
    systems |= {
        name: build.reference_systems(plant, trained.law)[name]
        for name in ("nominal", "oracle")
    }
    place, rows = Path(settings["root"]) / settings["name"], []
    folder = place / f"{track.name}_{_name(settings)}"
    with artefacts.locked(folder):
        for name, system in systems.items():
            artefacts.print_message(
                f"driving {settings['demo']['episodes']} x {settings['demo']['episode_s']:.0f} s: {name}"
            )
            driven = evaluate_system.compile_system(
                settings, plant, name, system, None
            )(track)
            rows.append(grid.write_cell(folder / name, settings, track, driven))
        rows = evaluation.compare(rows)
        document = {"rows": rows, "config": settings, "versions": artefacts.versions()}
        artefacts.write_json(folder / "results.json", document)
        _print(rows)
        film = animate(place, rows, track.name, corridor=_corridor(trained))
    artefacts.print_message(
        f"animation: {film}; {time.perf_counter() - began:.0f} s in all"
    )
    return {
        "animation": film and str(film),
        "rows": len(rows),
        "results": str(folder / "results.json"),
    }


def _name(settings: dict[str, Any]) -> str:
    """Of the policy that is asked for."""
    return settings["vehicle"]["name"] + ALONG_PATH * store.is_along_path(settings)


def _shipped(settings: dict[str, Any]) -> policy.Policy:
    """The policy for a vehicle, with a certificate that holds."""
    if settings["env_source"] == "none":
        raise ValueError(
            "the controllers that ship read the environment; choose env_source=measured or env_source=estimated"
        )
    name, places = (
        _name(settings),
        sorted(place.name for place in SHIPPED.iterdir() if place.is_dir()),
    )
    began = time.perf_counter()
    trained = (
        policy.load(SHIPPED / name, controller=settings["controller"])
        if name in places
        else None
    )
    if trained is None or trained.settings["vehicle"] != settings["vehicle"]:
        known = " and ".join(
            place for place in places if not place.endswith(ALONG_PATH)
        )
        raise ValueError(
            f"controllers ship for {known} as they are; for another vehicle run train"
        )
    if trained.certificate is None:
        raise artefacts.ArtefactError(
            f"{SHIPPED / name} was changed: its certificate is about other weights"
        )
    alpha, seconds = trained.certificate["alpha"], time.perf_counter() - began
    artefacts.print_message(
        f"certificate: holds, alpha {alpha:.4f}; loaded and verified in {seconds:.1f} s"
    )
    if half := _corridor(trained):
        share = 100 * trained.certificate["corridor"]["level"]
        artefacts.print_message(
            f"corridor: {half:.2f} m to each side, on {share:.0f} % of the drives of its class"
        )
    return trained


def _corridor(trained: policy.Policy) -> float | None:
    """How far from its path the car is certified to stay [m], if along a path."""
    return (trained.certificate or {}).get("corridor", {}).get("corridor_m")


def _print(rows: list[dict[str, Any]]) -> None:
    """The table, for a person."""
    artefacts.print_message(
        f"{'':10}{'deviation [mm]':>16}{'largest [mm]':>14}{'steering [rad/s]':>18}{'outside the proof':>19}"
    )
    for row in rows:
        left, largest = 1e3 * row["rmse_m"]["mean"], 1e3 * row["max_deviation_m"]
        broken = row["violation"]["v0"]
        outside = "nothing proved" if broken is None else f"{100 * broken:.0f} %"
        artefacts.print_message(
            f"{row['system']:10}{left:16.1f}{largest:14.0f}{row['smoothness_rad_per_s']:18.3f}{outside:>19}"
        )


if __name__ == "__main__":
    hydra_command(run)()
