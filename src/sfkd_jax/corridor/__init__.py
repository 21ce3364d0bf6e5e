"""Calibrate, test and attack the corridor of a policy in path coordinates."""

from sfkd_jax.corridor._certify import certify_corridor as certify_corridor
from sfkd_jax.corridor._drives import drive_measurement as drive_measurement
from sfkd_jax.corridor._drives import drive_options as drive_options
from sfkd_jax.corridor._drives import policy_loop as policy_loop
from sfkd_jax.corridor._speed import corridor_by_speed as corridor_by_speed
from sfkd_jax.corridor._speed import fastest_speeds as fastest_speeds
