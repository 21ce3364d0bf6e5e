"""Simulated vehicles as pure step functions."""

from sfkd_jax.driving.plants._actuators import with_servo as with_servo
from sfkd_jax.driving.plants._actuators import with_speed_loop as with_speed_loop
from sfkd_jax.driving.plants._along_path import along_path as along_path
from sfkd_jax.driving.plants._along_path import axes as axes
from sfkd_jax.driving.plants._along_path import path_states as path_states
from sfkd_jax.driving.plants._dynamic import dynamic as dynamic
from sfkd_jax.driving.plants._kinematic import kinematic as kinematic
from sfkd_jax.driving.plants._kinematic import kinematic_stiff as kinematic_stiff
from sfkd_jax.driving.plants._late import Late as Late
from sfkd_jax.driving.plants._late import LateState as LateState
from sfkd_jax.driving.plants._late import late_loop as late_loop
from sfkd_jax.driving.plants._own import check_step as check_step
from sfkd_jax.driving.plants._own import described as described
from sfkd_jax.driving.plants._own import hidden_change as hidden_change
from sfkd_jax.driving.plants._own import on_host as on_host
from sfkd_jax.driving.plants._own import own as own
from sfkd_jax.driving.plants._own import simulator as simulator
from sfkd_jax.driving.plants._variables import FRICTION as FRICTION
from sfkd_jax.driving.plants._variables import KNOWN_STATES as KNOWN_STATES
from sfkd_jax.driving.plants._variables import MASS as MASS
from sfkd_jax.driving.plants._variables import Size as Size
from sfkd_jax.driving.plants._variables import roles_of as roles_of
from sfkd_jax.driving.plants._vehicle import Vehicle as Vehicle
from sfkd_jax.driving.plants._vehicle import equivalent_wind as equivalent_wind
from sfkd_jax.driving.plants._vehicle import rk4 as rk4
from sfkd_jax.driving.plants._vehicle import side_force as side_force

FACTORIES = {
    "kinematic": kinematic,
    "kinematic_stiff": kinematic_stiff,
    "dynamic": dynamic,
}
"""Factories of the vehicles of this package by name; a new one is an entry here."""
