"""Systems that an evaluation compares, and the law of path coordinates."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from sfkd_jax import control, models, plants
from sfkd_jax.build._choices import Settings, as_kwargs, floats
from sfkd_jax.types import Environment, Model


class System(NamedTuple):
    """A system that an evaluation drives: a row of its table.

    Attributes:
        model: that the controller predicts with.
        params: of the model.
        env_source: where its environment comes from: "measured", "estimated" or "none".
        certificate: verified, or None.
        law: that a model in path coordinates was learned around, or None.
    """

    model: Model
    params: Any
    env_source: str
    certificate: dict[str, Any] | None = None
    law: control.PathLaw | None = None


def build_law(settings: Settings, plant: plants.Vehicle) -> control.PathLaw | None:
    """Derive the law of a data set in path coordinates from the vehicle's step.

    Args:
        settings: of the data set.
        plant: any vehicle with limits of its controls.

    Returns:
        The law, or None if the data set is not in path coordinates.
    """
    if "law" not in settings:
        return None
    box = {name: floats(settings[name]) for name in ("env_low", "env_high")}
    size = len(plant.state_names) - 1
    return control.derive_path_law(
        plant.step, coordinates=size, **box, **as_kwargs(settings["law"])
    )


def build_loop(plant: plants.Vehicle, law: control.PathLaw) -> plants.Vehicle:
    """Return the closed loop of plant and law, in the coordinates of `path_frame`."""
    steering, drive = (float(largest) for largest in law.perturbation)
    return plants.along_path(plant, law, perturbation=(steering, drive))


def reference_systems(
    plant: plants.Vehicle, law: control.PathLaw | None = None
) -> dict[str, System]:
    """Return the systems that need no learning, by name.

    "nominal" predicts with the bicycle, "oracle" with the true plant, and "oracle_…"
    with the true plant under a wrong environment. With a law they describe its closed
    loop, in path coordinates; "law" is then the oracle once more, for a planner without
    samples (`num_samples=1`), so that the law drives alone.

    Args:
        plant: the true vehicle.
        law: of path coordinates, or None.
    """

    def biased(entry: int, factor: float) -> Callable[[Environment], Environment]:
        return lambda env: env.at[entry].multiply(factor)

    along = law is not None
    plant = plant if law is None else build_loop(plant, law)
    oracle = partial(models.physics, plant.step, along_path=along)
    rows = {
        "nominal": System(models.physics(plant.nominal, along_path=along), {}, "none"),
        "oracle": System(oracle(), {}, "measured"),
    }
    if along:
        rows["law"] = rows["oracle"]
    distortions = {
        "friction_x0.7": (0, 0.7),
        "friction_x1.3": (0, 1.3),
        "wind_x0": (1, 0.0),
        "wind_x2": (1, 2.0),
    }
    for name, change in distortions.items():
        rows[f"oracle_{name}"] = System(oracle(distort=biased(*change)), {}, "measured")
    return {name: row._replace(law=law) for name, row in rows.items()}
