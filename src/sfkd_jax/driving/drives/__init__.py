"""Simulated drives to learn from."""

from sfkd_jax.driving.drives._generation import Driver as Driver
from sfkd_jax.driving.drives._generation import generate as generate
from sfkd_jax.driving.drives._generation import generate_open_loop as generate_open_loop
from sfkd_jax.driving.drives._path_runs import Reading as Reading
from sfkd_jax.driving.drives._path_runs import Sensors as Sensors
from sfkd_jax.driving.drives._path_runs import check_on_path as check_on_path
from sfkd_jax.driving.drives._path_runs import drive_along_path as drive_along_path
from sfkd_jax.driving.drives._path_runs import (
    generate_along_path as generate_along_path,
)
from sfkd_jax.driving.drives._schedules import SCENARIOS as SCENARIOS
from sfkd_jax.driving.drives._schedules import from_s3 as from_s3
from sfkd_jax.driving.drives._schedules import segment_scenarios as segment_scenarios
