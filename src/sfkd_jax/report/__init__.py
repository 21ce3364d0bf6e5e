"""Pages, tables, figures and films of runs: reads their files, computes nothing."""

from sfkd_jax.report.comparison import write_comparison as write_comparison
from sfkd_jax.report.comparison import write_results_page as write_results_page
from sfkd_jax.report.episodes import of_rows as of_rows
from sfkd_jax.report.film import Car as Car
from sfkd_jax.report.film import Film as Film
from sfkd_jax.report.film import film_of as film_of
from sfkd_jax.report.film import write_film as write_film
from sfkd_jax.report.run import write_report as write_report
