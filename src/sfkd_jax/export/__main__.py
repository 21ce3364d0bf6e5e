"""Export a controller for programs without sfkd_jax, or for C and C++."""

from __future__ import annotations

from typing import Any, cast

from sfkd_jax import policy, store
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.run import Run
from sfkd_jax.export._controller import write_controller
from sfkd_jax.settings import arguments


def main(run: Run) -> dict[str, Any]:
    """Export the policy of the run; nothing is trained or certified."""
    settings = run.settings
    run_dir = run.directory
    is_system = settings.system is not None
    file = policy.system_file(run_dir) if is_system else run.policy_path
    if not file.is_file():
        raise store.ArtefactError(
            f"{run_dir} holds no trained controller; "
            "run train with the same options first"
        )
    folder = run_dir / "export"
    with store.locked(run_dir):
        trained = policy.load_system(run_dir) if is_system else _of_vehicle(run)
        # Not refused: a controller without a certificate drives as well.
        if trained.certificate is None:
            store.print_message("exported without a certificate")
        options = arguments(settings.export, write_controller)
        write_controller(trained, folder, **options)
    store.print_message(
        f"exported: {folder}; python {folder / 'run_controller.py'} "
        "runs it without sfkd_jax"
    )
    return {
        "blob": str(folder / "controller.stablehlo"),
        "manifest": str(folder / "controller.json"),
        "policy": str(folder / file.name),
    }


def _of_vehicle(run: Run) -> policy.Policy:
    """Return the weights of a run with the controller of this command."""
    run.claim()
    loaded = policy.load(
        run.directory,
        controller=store.plain(run.settings.controller),
        env_source=run.settings.environment.source,
        # None: that of the certificate.
        latency=None if run.latency.is_none else run.latency,
    )
    # With settings of a controller, the policy of a system is refused.
    return cast(policy.Policy, loaded)


if __name__ == "__main__":
    hydra_command(main, of_systems=True)()
