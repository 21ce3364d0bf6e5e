"""Logs of drives: reading, checks, and data sets of them."""

from sfkd_jax.driving.logs._from_logs import LoggedDataset as LoggedDataset
from sfkd_jax.driving.logs._from_logs import from_logs as from_logs
from sfkd_jax.driving.logs._log_files import fingerprint as fingerprint
from sfkd_jax.driving.logs._logs import Columns as Columns
from sfkd_jax.driving.logs._recorded import recorded_runs as recorded_runs
from sfkd_jax.driving.logs._recorded import recorder as recorder
