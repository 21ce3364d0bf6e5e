"""Ink: what run directories hold, as pages. Reads artefacts and recomputes nothing."""

from sfkd_jax.reporting._animation import animate as animate
from sfkd_jax.reporting._animation import draw_film as draw_film
from sfkd_jax.reporting._benchmark import benchmark_markdown as benchmark_markdown
from sfkd_jax.reporting._benchmark import benchmark_report as benchmark_report
from sfkd_jax.reporting._comparison import write_comparison as write_comparison
from sfkd_jax.reporting._corridor import draw_hostile as draw_hostile
from sfkd_jax.reporting._page import write_report as write_report
from sfkd_jax.reporting._speed import draw_speed as draw_speed
