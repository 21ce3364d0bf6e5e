"""Driving data: generated or recorded, its parts, windows and scales."""

from sfkd_jax.data._dataset import PARTS as PARTS
from sfkd_jax.data._dataset import Dataset as Dataset
from sfkd_jax.data._dataset import check_shares as check_shares
from sfkd_jax.data._dataset import coverage as coverage
from sfkd_jax.data._dataset import environment_box as environment_box
from sfkd_jax.data._dataset import measure_space as measure_space
from sfkd_jax.data._dataset import random_windows as random_windows
from sfkd_jax.data._dataset import sizes_of_parts as sizes_of_parts
from sfkd_jax.data._dataset import split as split
from sfkd_jax.data._dataset import spread_windows as spread_windows
from sfkd_jax.data._from_logs import LoggedDataset as LoggedDataset
from sfkd_jax.data._from_logs import from_logs as from_logs
from sfkd_jax.data._generation import Driver as Driver
from sfkd_jax.data._generation import generate as generate
from sfkd_jax.data._generation import generate_open_loop as generate_open_loop
from sfkd_jax.data._log_files import fingerprint as fingerprint
from sfkd_jax.data._logs import Columns as Columns
from sfkd_jax.data._path_runs import check_on_path as check_on_path
from sfkd_jax.data._path_runs import drive_along_path as drive_along_path
from sfkd_jax.data._path_runs import generate_along_path as generate_along_path
from sfkd_jax.data._path_runs import sensor_keys as sensor_keys
from sfkd_jax.data._recorded import recorded_runs as recorded_runs
from sfkd_jax.data._recorded import recorder as recorder
from sfkd_jax.data._schedules import SCENARIOS as SCENARIOS
from sfkd_jax.data._schedules import from_s3 as from_s3
from sfkd_jax.data._schedules import segment_scenarios as segment_scenarios
