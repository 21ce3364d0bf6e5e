"""The results page of a comparison, and its LaTeX table."""

from sfkd_jax.paper._animation import animate as animate
from sfkd_jax.paper._animation import draw_film as draw_film
from sfkd_jax.paper._beside import beside_the_paper as beside_the_paper
from sfkd_jax.paper._hostile import draw_hostile as draw_hostile
from sfkd_jax.paper._page import results_markdown as results_markdown
from sfkd_jax.paper._page import write_results_page as write_results_page
from sfkd_jax.paper._speed import draw_speed as draw_speed
from sfkd_jax.paper._sweep_page import write_comparison as write_comparison
