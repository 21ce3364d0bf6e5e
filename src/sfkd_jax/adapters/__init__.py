"""Adapters to brax, gymnasium and CommonRoad.

Our vehicles are environments of brax and gymnasium; brax systems and CommonRoad's cars
are plants, and brax systems also systems to certify. A shield wraps any environment of
gymnasium. Each adapter, and the package it needs, is imported on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sfkd_jax.adapters._task import DrivingTask as DrivingTask
from sfkd_jax.adapters._task import LaneTask as LaneTask
from sfkd_jax.adapters._task import Moment as Moment
from sfkd_jax.adapters._task import Transition as Transition

if TYPE_CHECKING:
    from sfkd_jax.adapters._brax import BraxPlant as BraxPlant
    from sfkd_jax.adapters._brax import BraxVehicle as BraxVehicle
    from sfkd_jax.adapters._brax import brax_plant as brax_plant
    from sfkd_jax.adapters._brax import brax_system as brax_system
    from sfkd_jax.adapters._commonroad import commonroad_vehicle as commonroad_vehicle
    from sfkd_jax.adapters._gymnasium import GymnasiumLane as GymnasiumLane
    from sfkd_jax.adapters._gymnasium import GymnasiumVehicle as GymnasiumVehicle
    from sfkd_jax.adapters._gymnasium import register_gymnasium as register_gymnasium
    from sfkd_jax.adapters._gymnasium_shield import GymnasiumShield as GymnasiumShield

_LAZY = {
    ("_brax", "brax"): ("BraxPlant", "BraxVehicle", "brax_plant", "brax_system"),
    ("_commonroad", "plants"): ("commonroad_vehicle",),
    ("_gymnasium_shield", "gym"): ("GymnasiumShield",),
    ("_gymnasium", "gym"): ("GymnasiumLane", "GymnasiumVehicle", "register_gymnasium"),
}
"""File and the extra that installs what it imports -> its public names."""


def __getattr__(name: str) -> Any:
    """Import an adapter on first use; without its package, name the extra."""
    # Lazy: without brax the gymnasium adapter works, and the other way round.
    for (file, extra), names in _LAZY.items():
        if name not in names:
            continue
        try:
            return getattr(import_module(f"sfkd_jax.adapters.{file}"), name)
        except ModuleNotFoundError as missing:
            package = str(missing.name).partition(".")[0]
            raise ImportError(
                f"sfkd_jax.adapters.{name} needs {package}: "
                f'pip install "sfkd-jax[{extra}]"'
            ) from missing
    raise AttributeError(f"module 'sfkd_jax.adapters' has no attribute {name!r}")
