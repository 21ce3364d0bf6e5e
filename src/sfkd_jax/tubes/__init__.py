"""Tubes of the closed loop of a system: measured on runs, and verified."""

from sfkd_jax.tubes._measuring import measure_tubes as measure_tubes
from sfkd_jax.tubes._verification import verify_system as verify_system
