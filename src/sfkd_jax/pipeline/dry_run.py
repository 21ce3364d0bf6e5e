"""A rehearsal: whether what settings choose can be built, asked before anything is made that takes long."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sfkd_jax import build
from sfkd_jax.certification import MODES
from sfkd_jax.control import PathLaw
from sfkd_jax.datasets import check_shares
from sfkd_jax.pipeline import store
from sfkd_jax.types import Space
from sfkd_jax.vehicle import Vehicle


def check(settings: dict[str, Any], plant: Vehicle) -> None:
    """Build what settings choose, on scales of 1 and under a certificate of anything, and forget it.

    Raises:
        ValueError: naming the setting, or the choices.
    """
    data, window = settings["dataset"], settings["training"]["window"]
    check_shares(tuple(data["shares"]))
    if window > data["steps"]:
        raise ValueError(
            f"training.window={window} does not fit segments of dataset.steps={data['steps']}"
        )
    build.choose(
        dict.fromkeys(MODES), settings["certification"]["mode"], "certification.mode"
    )
    told = data["columns"]["environment"] if store.is_logged(settings) else ()
    along = store.is_along_path(settings)
    sizes = {"state": len(plant.state_names) - 3, "control": 2, "env": len(told) or 2}
    if along:
        sizes |= {"state": sizes["state"] + 2, "control": 4}
    law = _any_law(sizes) if along else None
    for name in settings["evaluation"]["systems"]:
        build.choose(
            {"self": None} | build.reference_systems(plant, law),
            name,
            "evaluation.systems entry",
        )
    scales = (
        part(size) for size in (*sizes.values(), 3) for part in (jnp.zeros, jnp.ones)
    )
    model = build.build_model(settings["model"], Space(*scales), plant)
    if model.along_path != along:
        raise ValueError(
            "model.frame=path and dataset=path go together: path coordinates for both or for neither"
        )
    if plant.control_low:
        boxes = {name: ((-1.0,) * size, (1.0,) * size) for name, size in sizes.items()}
        limits: dict[str, Any] = dict(
            zip(("env_low", "env_high"), boxes["env"], strict=True)
        )
        limits |= {"law": law}
        limits |= {
            "certificate": {"boxes": boxes, "monitor": {"bounds": (1.0,) * 4}},
            "env_source": settings["env_source"],
        }
        build.build_controller(settings["controller"], model, plant, **limits)


def _any_law(sizes: dict[str, int]) -> PathLaw:
    """A law that asks for nothing."""
    axes, corners = 2 + sizes["env"], (2,) * (2 + sizes["env"])
    tables = (
        jnp.zeros((*corners, *shape))
        for shape in ((sizes["state"],), (2,), (2, sizes["state"]))
    )
    return PathLaw(jnp.zeros(axes), jnp.ones(axes), jnp.ones(2), *tables)
