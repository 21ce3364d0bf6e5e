"""Pages, tables, figures and films of runs: reads their files, computes nothing."""

from sfkd_jax.report.comparison import write_comparison as write_comparison
from sfkd_jax.report.comparison import write_results_page as write_results_page
from sfkd_jax.report.episodes import of_rows as of_rows
from sfkd_jax.report.film import film_of as film_of
from sfkd_jax.report.run import write_report as write_report
from sfkd_jax.report.tables import text_table as text_table
