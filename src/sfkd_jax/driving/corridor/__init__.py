"""The corridor of a vehicle: calibration, attack and verification."""

from sfkd_jax.driving.corridor._bounds import corridor_coverage as corridor_coverage
from sfkd_jax.driving.corridor._closed_loop import closed_loop as closed_loop
from sfkd_jax.driving.corridor._measuring import calibrate_on_runs as calibrate_on_runs
from sfkd_jax.driving.corridor._measuring import measure_corridor as measure_corridor
from sfkd_jax.driving.corridor._runs import scores_of_runs as scores_of_runs
from sfkd_jax.driving.corridor._runs import simulated_steps as simulated_steps
from sfkd_jax.driving.corridor._verification import verify_driving as verify_driving
