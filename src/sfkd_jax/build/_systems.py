"""Rows of a table: what is driven, by which model, told what; and the law of path coordinates."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from sfkd_jax import control, models, vehicle
from sfkd_jax.build._choices import Settings, floats, without
from sfkd_jax.types import Environment, Model


class System(NamedTuple):
    """A row of a table: a model with its parameters, what it is told about the environment, and its certificate.

    Of a model in path coordinates also the law that it was learned around.
    """

    model: Model
    params: Any
    env_source: str
    certificate: dict[str, Any] | None = None
    law: control.PathLaw | None = None


def build_law(settings: Settings, plant: vehicle.Vehicle) -> control.PathLaw | None:
    """The law of a data set in path coordinates, derived from the vehicle's own step; None for other data sets.

    Args:
        settings: of the data set.
        plant: any vehicle with limits of its controls.
    """
    if "law" not in settings:
        return None
    box = {name: floats(settings[name]) for name in ("env_low", "env_high")}
    size = len(plant.state_names) - 1
    return control.derive_path_law(
        plant.step, coordinates=size, **box, **without(settings["law"])
    )


def build_loop(plant: vehicle.Vehicle, law: control.PathLaw) -> vehicle.Vehicle:
    """The plant with a law closed around it: states and controls of `path_frame`."""
    steering, drive = (float(largest) for largest in law.perturbation)
    return vehicle.along_path(plant, law, perturbation=(steering, drive))


def reference_systems(
    plant: vehicle.Vehicle, law: control.PathLaw | None = None
) -> dict[str, System]:
    """Rows that need no learning: the nominal bicycle, the true plant, and the true plant wrong about e.

    With a law they are those of the loop around the plant, in path coordinates, and
    "law" is beside them: the true plant once more, for a planner that draws no samples
    (`num_samples=1`), so that the law drives alone.
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
