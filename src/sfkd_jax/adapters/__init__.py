"""Adapters to brax, gymnasium and CommonRoad.

Our vehicles are environments of brax and gymnasium; brax systems and CommonRoad's cars
are plants. Each adapter, and the package it needs, is imported on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sfkd_jax.adapters._task import DrivingTask as DrivingTask
from sfkd_jax.adapters._task import Moment as Moment
from sfkd_jax.adapters._task import Transition as Transition
from sfkd_jax.adapters._task import tracking_task as tracking_task

if TYPE_CHECKING:
    from sfkd_jax.adapters._brax import BraxPlant as BraxPlant
    from sfkd_jax.adapters._brax import BraxVehicle as BraxVehicle
    from sfkd_jax.adapters._brax import brax_plant as brax_plant
    from sfkd_jax.adapters._brax import collect as collect
    from sfkd_jax.adapters._brax import register_brax as register_brax
    from sfkd_jax.adapters._commonroad import (
        commonroad_controller as commonroad_controller,
    )
    from sfkd_jax.adapters._commonroad import (
        commonroad_observation as commonroad_observation,
    )
    from sfkd_jax.adapters._commonroad import commonroad_vehicle as commonroad_vehicle
    from sfkd_jax.adapters._gymnasium import GymnasiumVehicle as GymnasiumVehicle
    from sfkd_jax.adapters._gymnasium import register_gymnasium as register_gymnasium

_EXTRAS = {"_brax": "brax", "_commonroad": "plants", "_gymnasium": "gym"}
_LAZY = {
    "BraxVehicle": "_brax",
    "register_brax": "_brax",
    "BraxPlant": "_brax",
    "brax_plant": "_brax",
    "collect": "_brax",
    "commonroad_controller": "_commonroad",
    "commonroad_observation": "_commonroad",
    "commonroad_vehicle": "_commonroad",
    "GymnasiumVehicle": "_gymnasium",
    "register_gymnasium": "_gymnasium",
}
"""Public name -> its file; and file -> the extra that installs what it imports."""


def __getattr__(name: str) -> Any:
    """Import an adapter on first use; without its package, name the extra."""
    # Lazy: without brax the gymnasium adapter works, and the other way round.
    if name not in _LAZY:
        raise AttributeError(f"module 'sfkd_jax.adapters' has no attribute {name!r}")
    file = _LAZY[name]
    try:
        module = import_module(f"sfkd_jax.adapters.{file}")
    except ModuleNotFoundError as missing:
        package = str(missing.name).partition(".")[0]
        command = f'pip install "sfkd-jax[{_EXTRAS[file]}]"'
        raise ImportError(
            f"sfkd_jax.adapters.{name} needs {package}: {command}"
        ) from missing
    return getattr(module, name)
