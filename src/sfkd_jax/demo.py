"""Drive a policy that ships with the package; nothing is trained.

With `viewer=true` it drives in its lane, live in a browser.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

from sfkd_jax import assembly, policy, store, viewer
from sfkd_jax.assembly import VehicleSettings
from sfkd_jax.experiment import evaluating, run_directory
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings
from sfkd_jax.experiment.run import Run
from sfkd_jax.report.episodes import of_rows
from sfkd_jax.report.film import film_of
from sfkd_jax.report.tables import text_table
from sfkd_jax.settings import parse, replace

PRINTED = ("rmse_m", "max_deviation_m", "smoothness_rad_per_s")
"""Metrics of the table."""


def main(run: Run) -> dict[str, Any]:
    """Simulate a shipped policy beside nominal and oracle, or show it live."""
    settings = run.settings
    name = settings.vehicle.name
    shipped = f"{name}_path" if run.source.along_path else name
    if settings.viewer:
        return _show(settings, shipped)
    return _compare(run, shipped)


def _show(settings: Settings, shipped: str) -> dict[str, Any]:
    """Show a shipped policy in its lane until Ctrl-C."""
    # Before minutes of compiling: the package may be missing, or the port in use.
    with viewer.served(settings.demo.port) as server:
        drive = viewer.live_drive(_load(settings, shipped))
        store.print_message("compiling the control step, which may take a minute")
        return viewer.show(server, drive, seed=settings.seed, started=_print_address)


def _print_address(address: str, _: viewer.Panel) -> None:
    """Say where the page is."""
    store.print_message(f"live at {address} until Ctrl-C")


def _compare(run: Run, shipped: str) -> dict[str, Any]:
    """Simulate a shipped policy beside nominal and oracle; print a table, animate."""
    began = time.perf_counter()
    settings = run.settings
    trained = _load(settings, shipped)
    protocol = replace(
        settings.evaluation,
        episodes=settings.demo.episodes,
        episode_s=settings.demo.episode_s,
    )
    settings = replace(settings, name="demo", evaluation=protocol)
    run = Run(settings, run.source)
    episodes = evaluating.make_episodes(run)
    home = Path(settings.root) / settings.name / f"{episodes.name}_{shipped}"
    references = assembly.reference_systems(run.plant, trained.law)
    corridor = trained.certificate.corridor if trained.certificate else None
    systems = {
        trained.settings["model"]["system"]: assembly.System(
            trained.model,
            trained.params,
            settings.environment.source,
            trained.certificate,
            trained.law,
        ),
        "nominal": references["nominal"],
        "oracle": references["oracle"],
    }
    with store.locked(home):
        driven = evaluating.drive(run, systems, episodes)
        seconds = time.perf_counter() - began
        results = run_directory.write_results(
            home, store.plain(settings), driven, seconds
        )
        # The last ones: those of an earlier demo with other settings come before.
        rows = run_directory.read_results(home)[-len(driven) :]
        store.print_message(text_table(rows, *PRINTED))
        half_width = corridor.corridor_m if corridor else None
        path = home.with_name(f"{home.name}.gif")
        film = film_of(path, of_rows(home, rows), half_width)
    seconds = time.perf_counter() - began
    store.print_message(f"animation: {film}; {seconds:.0f} s in all")
    return {
        "animation": str(film) if film else None,
        "rows": len(rows),
        "results": str(results),
    }


def _load(settings: Settings, name: str) -> policy.Policy:
    """Return the shipped policy of a name, with its verified certificate."""
    if not settings.environment.is_known:
        raise ValueError(
            "the controllers that ship read the environment; "
            "choose environment=measured or environment=estimated"
        )
    # The folder of the package: a folder of this name may lie where the demo starts.
    directory = policy.SHIPPED / name
    trained = None
    if directory.is_dir():
        loaded = policy.load(directory, controller=store.plain(settings.controller))
        # With settings of a controller, the policy of a system is refused.
        trained = cast(policy.Policy, loaded)
    saved = None
    if trained is not None:
        # A policy was saved without the settings that came later.
        saved = parse(VehicleSettings, trained.settings["vehicle"], "vehicle.")
    if trained is None or saved != settings.vehicle:
        vehicles = sorted({shipped.vehicle for shipped in policy.policies().values()})
        raise ValueError(
            f"controllers ship for {' and '.join(vehicles)} as they are; "
            "for another vehicle run train"
        )
    if trained.certificate is None:
        raise store.ArtefactError(
            f"{directory} was changed: its certificate is about other weights"
        )
    store.print_message(repr(trained))
    return trained


if __name__ == "__main__":
    hydra_command(main)()
