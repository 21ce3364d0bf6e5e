"""Drive a policy that ships with the package; nothing is trained."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sfkd_jax import build, policy, store
from sfkd_jax.experiment import evaluating, runs
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings
from sfkd_jax.report.episodes import of_rows
from sfkd_jax.report.film import film_of
from sfkd_jax.report.tables import text_table
from sfkd_jax.settings import replace

SHIPPED = Path(__file__).with_name("pretrained")
"""vehicle, or vehicle_path in path coordinates -> policy.safetensors and its
certificate, as `train` wrote them.
"""
ALONG_PATH = "_path"
PRINTED = ("rmse_m", "max_deviation_m", "smoothness_rad_per_s")
"""Metrics of the table."""


def run(settings: Settings) -> dict[str, Any]:
    """Simulate a shipped policy beside nominal and oracle; print a table, animate."""
    began, about = time.perf_counter(), settings.demo
    shipped = settings.vehicle.name + ALONG_PATH * bool(settings.along_path)
    trained = _load(settings, SHIPPED / shipped)
    protocol = replace(settings.evaluation, **vars(about))
    settings = replace(settings, name="demo", evaluation=protocol)
    episodes = evaluating.make_episodes(settings)
    home = Path(settings.root) / settings.name / f"{episodes.name}_{shipped}"
    plant = build.build_vehicle(settings.vehicle)
    references = build.reference_systems(plant, trained.law)
    source, proof = settings.environment.source, trained.certificate
    own = build.System(trained.model, trained.params, source, proof, trained.law)
    systems = {trained.settings["model"]["system"]: own}
    systems |= {name: references[name] for name in ("nominal", "oracle")}
    with store.locked(home):
        found = evaluating.drive(settings, systems, episodes)
        seconds = time.perf_counter() - began
        results = runs.write_results(home, store.plain(settings), found, seconds)
        # The last ones: those of an earlier demo with other settings come before.
        rows = runs.read_results(home)[-len(found) :]
        store.print_message(text_table(rows, *PRINTED))
        half_width = (proof or {}).get("corridor", {}).get("corridor_m")
        path = home.with_name(f"{home.name}.gif")
        film = film_of(path, of_rows(home, rows), half_width)
    seconds = time.perf_counter() - began
    store.print_message(f"animation: {film}; {seconds:.0f} s in all")
    animation = film and str(film)
    return {"animation": animation, "rows": len(rows), "results": str(results)}


def _load(settings: Settings, directory: Path) -> policy.Policy:
    """Return the policy for a vehicle, with its verified certificate."""
    if not settings.environment.is_known:
        raise ValueError(
            "the controllers that ship read the environment; "
            "choose environment=measured or environment=estimated"
        )
    trained = None
    if directory.is_dir():
        trained = policy.load(directory, controller=store.plain(settings.controller))
    if trained is None or trained.settings["vehicle"] != store.plain(settings.vehicle):
        names = sorted({one.name.split("_")[0] for one in SHIPPED.iterdir()})
        raise ValueError(
            f"controllers ship for {' and '.join(names)} as they are; "
            "for another vehicle run train"
        )
    if trained.certificate is None:
        raise store.ArtefactError(
            f"{directory} was changed: its certificate is about other weights"
        )
    store.print_message(repr(trained))
    return trained


if __name__ == "__main__":
    hydra_command(run)()
