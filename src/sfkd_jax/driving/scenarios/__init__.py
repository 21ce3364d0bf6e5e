"""Driving scenarios: paths, environment schedules, S1 to S3."""

from sfkd_jax.driving.scenarios._conditions import BOX as BOX
from sfkd_jax.driving.scenarios._conditions import gusts as gusts
from sfkd_jax.driving.scenarios._conditions import held_road as held_road
from sfkd_jax.driving.scenarios._conditions import in_box as in_box
from sfkd_jax.driving.scenarios._conditions import (
    random_side_forces as random_side_forces,
)
from sfkd_jax.driving.scenarios._conditions import switching_road as switching_road
from sfkd_jax.driving.scenarios._conditions import uniform_road as uniform_road
from sfkd_jax.driving.scenarios._conditions import wet_road as wet_road
from sfkd_jax.driving.scenarios._drives import DRIVES as DRIVES
from sfkd_jax.driving.scenarios._drives import DriveClass as DriveClass
from sfkd_jax.driving.scenarios._drives import random_drive as random_drive
from sfkd_jax.driving.scenarios._scenarios import COURSES as COURSES
from sfkd_jax.driving.scenarios._scenarios import ROADS as ROADS
from sfkd_jax.driving.scenarios._scenarios import Course as Course
from sfkd_jax.driving.scenarios._scenarios import Family as Family
from sfkd_jax.driving.scenarios._scenarios import Scenario as Scenario
from sfkd_jax.driving.scenarios._scenarios import beside as beside
from sfkd_jax.driving.scenarios._scenarios import car_clearance as car_clearance
from sfkd_jax.driving.scenarios._scenarios import family as family
from sfkd_jax.driving.scenarios._scenarios import in_view as in_view
from sfkd_jax.driving.scenarios._scenarios import scenario as scenario
from sfkd_jax.driving.scenarios._scenarios import smooth_path as smooth_path
