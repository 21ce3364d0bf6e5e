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
    from sfkd_jax.adapters._brax import BraxVehicle as BraxVehicle
    from sfkd_jax.adapters._brax import register_brax as register_brax
    from sfkd_jax.adapters._brax_system import BraxPlant as BraxPlant
    from sfkd_jax.adapters._brax_system import brax_plant as brax_plant
    from sfkd_jax.adapters._brax_system import collect as collect
    from sfkd_jax.adapters._commonroad import (
        commonroad_controller as commonroad_controller,
    )
    from sfkd_jax.adapters._commonroad import (
        commonroad_observation as commonroad_observation,
    )
    from sfkd_jax.adapters._commonroad import commonroad_vehicle as commonroad_vehicle
    from sfkd_jax.adapters._gymnasium import GymnasiumVehicle as GymnasiumVehicle
    from sfkd_jax.adapters._gymnasium import register_gymnasium as register_gymnasium

_LAZY = {
    "BraxVehicle": ("_brax", "brax"),
    "register_brax": ("_brax", "brax"),
    "BraxPlant": ("_brax_system", "brax"),
    "brax_plant": ("_brax_system", "brax"),
    "collect": ("_brax_system", "brax"),
    "commonroad_controller": ("_commonroad", "plants"),
    "commonroad_observation": ("_commonroad", "plants"),
    "commonroad_vehicle": ("_commonroad", "plants"),
    "GymnasiumVehicle": ("_gymnasium", "gym"),
    "register_gymnasium": ("_gymnasium", "gym"),
}
"""Public name -> its file, and the extra that installs what the file imports."""


def __getattr__(name: str) -> Any:
    """Import an adapter on first use; without its package, name the extra."""
    if name not in _LAZY:
        raise AttributeError(f"module 'sfkd_jax.adapters' has no attribute {name!r}")
    file, extra = _LAZY[name]
    try:
        module = import_module(f"sfkd_jax.adapters.{file}")
    except ModuleNotFoundError as missing:
        package = str(missing.name).partition(".")[0]
        command = f'pip install "sfkd-jax[{extra}]"'
        raise ImportError(
            f"sfkd_jax.adapters.{name} needs {package}: {command}"
        ) from missing
    return getattr(module, name)
