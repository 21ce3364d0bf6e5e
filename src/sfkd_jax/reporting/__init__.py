"""Pages, tables and figures of runs: reads their files and recomputes nothing."""

from sfkd_jax.reporting._page import write_report as write_report
