"""Ink: what a run directory holds, as one page. Reads artefacts and recomputes nothing."""

from sfkd_jax.reporting._page import write_report as write_report
