"""What the paper adds to the page of a run: its RMSE, and side forces."""

from __future__ import annotations

from pathlib import Path

from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.paper._side_forces import disturbed, violations
from sfkd_jax.paper._texts import text
from sfkd_jax.reporting.blocks import Block, Heading, Text, picture
from sfkd_jax.reporting.rows import group_title, row_of
from sfkd_jax.reporting.style import scenario_label

PUBLISHED_RMSE_M = {
    "s2": {"mean": 0.098, "std": 0.014},
    "s3": {"mean": 0.120, "std": 0.018},
}
"""The paper's RMSE of SFKD by scenario; its simulator is another one."""


def beside_the_paper(groups: list[list[Row]], folder: Path) -> list[Block]:
    """Blocks for the page of a run, as the argument `studies` of `write_report`.

    Args:
        groups: rows that may be compared.
        folder: of the figures.
    """
    published, forces = [], []
    for group in groups:
        scenario, own = str(group[0].get("scenario")), row_of(group, "sfkd")
        if scenario in PUBLISHED_RMSE_M and own:
            where, theirs = scenario_label(scenario), PUBLISHED_RMSE_M[scenario]
            words = text("run.published", own, where=where, published=theirs)
            published.append(Text(words, "Beside the paper.", "note"))
        if forced := disturbed(group):
            number = sum(isinstance(block, Heading) for block in forces) + 1
            name = "figure2" if number == 1 else f"figure2_{number}"
            caption = text("run.side_forces")
            forces += [
                Heading(3, f"Side forces: {group_title(group)}"),
                picture(folder, name, caption, violations, forced),
            ]
    return [*published, *forces]
