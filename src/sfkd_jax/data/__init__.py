"""Driving data: generated or recorded, its parts, windows and scales."""

from sfkd_jax.data._along_path import drive_along_path as drive_along_path
from sfkd_jax.data._along_path import drive_switching as drive_switching
from sfkd_jax.data._along_path import generate_along_path as generate_along_path
from sfkd_jax.data._along_path import (
    generate_s3_along_path as generate_s3_along_path,
)
from sfkd_jax.data._along_path import (
    segment_scenarios_along_path as segment_scenarios_along_path,
)
from sfkd_jax.data._from_logs import LoggedDataset as LoggedDataset
from sfkd_jax.data._from_logs import environment_box as environment_box
from sfkd_jax.data._from_logs import from_logs as from_logs
from sfkd_jax.data._generation import Driver as Driver
from sfkd_jax.data._generation import generate as generate
from sfkd_jax.data._generation import generate_switching as generate_switching
from sfkd_jax.data._generation import segment_scenarios as segment_scenarios
from sfkd_jax.data._logs import Columns as Columns
from sfkd_jax.data._splits import SCENARIOS as SCENARIOS
from sfkd_jax.data._splits import Dataset as Dataset
from sfkd_jax.data._splits import check_shares as check_shares
from sfkd_jax.data._splits import coverage as coverage
from sfkd_jax.data._splits import first_share as first_share
from sfkd_jax.data._splits import measure_space as measure_space
from sfkd_jax.data._splits import random_windows as random_windows
from sfkd_jax.data._splits import split as split
from sfkd_jax.data._splits import spread_windows as spread_windows
from sfkd_jax.data._splits import windows as windows
from sfkd_jax.data._tables import fingerprint as fingerprint
from sfkd_jax.data._to_path import check_logged as check_logged
from sfkd_jax.data._to_path import check_on_path as check_on_path
from sfkd_jax.data._to_path import logged_path as logged_path
from sfkd_jax.data._to_path import to_path as to_path
