"""Export a controller for programs without sfkd_jax, or for C and C++."""

from __future__ import annotations

from typing import Any

from sfkd_jax import policy, store
from sfkd_jax.experiment import runs
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings
from sfkd_jax.export import write_controller
from sfkd_jax.settings import arguments, plain

FOLDER = "export"


def run(settings: Settings) -> dict[str, Any]:
    """Export the policy of the run; nothing is trained or certified.

    Raises:
        ArtefactError: the run has no policy, or one that is damaged or was trained
            with other settings.
    """
    run_dir = settings.run_dir
    if not (run_dir / "policy.safetensors").is_file():
        raise store.ArtefactError(
            f"{run_dir} holds no trained controller; "
            "run train with the same options first"
        )
    return _write(settings)


@runs.exclusive
def _write(settings: Settings) -> dict[str, Any]:
    """Export the policy while no other process writes to the run directory."""
    run_dir = settings.run_dir
    runs.claim(settings)
    manifest = store.read_manifest(run_dir / "policy.safetensors", kind=policy.KIND)
    # The weights of the run, the controller of this command.
    trained = policy.load(
        run_dir,
        controller=plain(settings.controller),
        env_source=settings.environment.source,
    )
    # Not refused: a controller without a certificate drives as well.
    if trained.certificate is None:
        store.print_message("exported without a certificate")
    folder = run_dir / FOLDER
    write_controller(
        trained,
        folder,
        made_from=manifest["made_from"],
        **arguments(settings.export, write_controller),
    )
    store.print_message(
        f"exported: {folder}; python {folder / 'run_controller.py'} "
        "runs it without sfkd_jax"
    )
    files = ("controller.stablehlo", "controller.json", "policy.safetensors")
    names = ("blob", "manifest", "policy")
    return {key: str(folder / file) for key, file in zip(names, files, strict=True)}


if __name__ == "__main__":
    hydra_command(run)()
