"""Data sets: their parts, windows and scales."""

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
