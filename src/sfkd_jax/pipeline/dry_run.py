"""Check before a long run that everything the settings choose can be built."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sfkd_jax import build
from sfkd_jax.certification import MODES
from sfkd_jax.control import PathLaw
from sfkd_jax.data import check_shares
from sfkd_jax.pipeline import runs
from sfkd_jax.plants import Vehicle
from sfkd_jax.types import Model, Space


def check_settings(settings: dict[str, Any], plant: Vehicle) -> None:
    """Build what the settings choose, with unit scales and an arbitrary certificate.

    Args:
        settings: of the run.
        plant: its vehicle.

    Raises:
        ValueError: naming the setting, or the choices.
    """
    data, window = settings["dataset"], settings["training"]["window"]
    check_shares(tuple(data["shares"]))
    if window > data["steps"]:
        raise ValueError(
            f"training.window={window} does not fit segments "
            f"of dataset.steps={data['steps']}"
        )
    build.choose(
        dict.fromkeys(MODES), settings["certification"]["mode"], "certification.mode"
    )
    along_path = runs.is_along_path(settings)
    sizes = _sizes(settings, plant)
    law = _zero_law(sizes) if along_path else None
    systems = {"self": None} | build.reference_systems(plant, law)
    for name in settings["evaluation"]["systems"]:
        build.choose(systems, name, "evaluation.systems entry")
    scales = (
        part(size) for size in (*sizes.values(), 3) for part in (jnp.zeros, jnp.ones)
    )
    model = build.build_model(settings["model"], Space(*scales), plant)
    if model.along_path != along_path:
        raise ValueError(
            "model.frame=path and dataset=path go together: "
            "path coordinates for both or for neither"
        )
    if plant.control_low:
        _build_controller(settings, plant, model, sizes, law)


def _sizes(settings: dict[str, Any], plant: Vehicle) -> dict[str, int]:
    """Sizes of body state, control and environment that the model reads."""
    logged = runs.is_logged(settings)
    columns = settings["dataset"]["columns"]["environment"] if logged else ()
    state = len(plant.state_names) - 3
    if runs.is_along_path(settings):
        return {"state": state + 2, "control": 4, "env": len(columns) or 2}
    return {"state": state, "control": 2, "env": len(columns) or 2}


def _build_controller(
    settings: dict[str, Any],
    plant: Vehicle,
    model: Model,
    sizes: dict[str, int],
    law: PathLaw | None,
) -> None:
    """Build the controller under a certificate with unit boxes."""
    boxes = {name: ((-1.0,) * size, (1.0,) * size) for name, size in sizes.items()}
    low, high = boxes["env"]
    build.build_controller(
        settings["controller"],
        model,
        plant,
        env_low=low,
        env_high=high,
        law=law,
        certificate={"boxes": boxes},
        env_source=settings["env_source"],
    )


def _zero_law(sizes: dict[str, int]) -> PathLaw:
    """A law whose output is zero."""
    axes, corners = 2 + sizes["env"], (2,) * (2 + sizes["env"])
    tables = (
        jnp.zeros((*corners, *shape))
        for shape in ((sizes["state"],), (2,), (2, sizes["state"]))
    )
    return PathLaw(jnp.zeros(axes), jnp.ones(axes), jnp.ones(2), *tables)
