"""Words around the tables of a comparison: its head, what the marks mean, and how it is made again."""

from __future__ import annotations

import shlex
from typing import Any

from sfkd_jax.reporting._benchmark_rows import (
    OFF_THE_ROAD_M,
    Contest,
    Row,
    contests,
    is_quoted,
    measure,
    scenarios,
)
from sfkd_jax.reporting._benchmark_seeds import has_trainings
from sfkd_jax.reporting._blocks import Block, Code, Heading, Table
from sfkd_jax.reporting._numbers import DASH, dig, is_number, number, plain
from sfkd_jax.reporting._tables import settings_table

FIGURE_1 = (
    "signed lateral deviation in the first episode, left positive. Shades and the words above: friction μ and side "
    "wind w, which switch at the dashed lines. SFKD and the oracle are in every panel; of the others the two best are"
    " drawn in full, the rest thin. A line that leaves the frame deviates further than the frame shows."
)
FIGURE_2 = (
    "while a side force that nobody measures pushes the car, redrawn every second, up to the named value to either "
    "side; the marker grows with it. Circles: conformal tubes, all at one level; squares: the certified tube. Right: "
    "the mean position radius of each tube; a tube that is wide enough is never left. Rows that are told friction and "
    "wind above, those that are not below, each group by its RMSE without a force."
)
FORCES = (
    "V0: steps at which the certified bound fails although no one-step error exceeded its assumption; the theorem says "
    "0. V1: segments that leave the tube around their prediction. V2: windows of prediction beyond one distance that "
    "is the same for every row. Left the lane: episodes. Numbers between slashes, one a force"
)
TITLES = {
    "table1": "The paper's table, row by row",
    "figure2": "Unmeasured side forces, row by row",
    "robustness": "Late, noisy and biased e, and worse sensors, row by row",
    "levels": "Steady friction and wind: seen, interpolated, extrapolated",
    "small_data": "Less training data, row by row",
    "estimated": "e inferred while driving",
    "seeds": "Trained from several seeds, row by row",
    "longer": "Twice the training, or a rate nearer to 1",
    "path_frame": "In path coordinates around one law, row by row",
}
_INTRODUCED = {
    "figure2": "A force that nobody measures pushes the car from the side, as in the paper's Figure 2.",
    "robustness": "What is told of friction and wind comes late, noisy or biased, or the sensors are worse than in the "
    "table; the plant and the policies stay as they are.",
    "levels": "Friction and wind stay what they are for a whole episode. Seen: as training drives have them; "
    "interpolated: friction between the levels that training drives have under wind; extrapolated: beyond the box that "
    "training drives cover.",
    "small_data": "The policies are trained anew on a share of the training segments; the rest of the protocol stays "
    "as it is.",
    "seeds": "The same rows, trained from several seeds on the same data: which differences are those of the systems, "
    "and which those of one training.",
    "longer": "Whether the rows with and without the bound differ because one of them is not yet trained to its end, "
    "or because the rate that the bound asks for is too far below 1.",
    "path_frame": "Every row drives around the same law and, where it learns, has the same data in path coordinates: "
    "what the bound costs, apart from what the coordinates do. Law alone: no planner, with the oracle's predictions.",
}


def heading(results: dict[str, Any]) -> str:
    """What the page is called, by the name of the comparison."""
    name = str(dig(results, "config", "name"))
    return TITLES.get(name, "A comparison, row by row")


_TRACKING = (
    "RMSE of the lateral deviation of the true state from the path, one number per episode; mean with its 95 % "
    "interval. (e): the model is told friction and wind; (no e): it is not. The oracle plans with the true vehicle, "
    "nominal with a bicycle that knows neither."
)
_PRINTED = " The paper has one row per system, which stands beside every variant of it; its simulator is another one."
AGAINST = (
    "RMSE of a row minus SFKD's on the same episodes, with the 95 % interval of the paired difference: * lies above "
    "zero, so SFKD is better; † lies below zero, so SFKD is worse; unmarked intervals hold zero."
)
CLAIMS = (
    "By scenario. V0: steps at which the certified bound fails although no one-step error exceeded its assumption. "
    "V1: segments that leave the tube around their prediction, with the mean radius of the tube beside it: a wide "
    "tube is easily kept."
)
LIMITS = (
    "By scenario. V2: windows of prediction beyond one distance that is the same for every row; the paper's rate is "
    "its own measure. Left the lane: episodes. Unhealthy: steps at which the planner held its last plan."
)
COST = (
    "Time of one compiled control step, all samples included. α is a certified bound; rows without one have no "
    "certificate."
)


def overview(group: list[Contest], paper: dict[str, Any]) -> str:
    """What the figure of all rows shows."""
    drawn = "over trainings and episodes" if has_trainings(group) else "over episodes"
    marks = "; strokes: single trainings" if has_trainings(group) else ""
    if is_quoted(group, paper):
        marks += "; crosses: what the paper prints for the row's system, measured in another simulator"
    means = [
        measure(line, name, "rmse_m", "mean")
        for one in group
        for line in one.lines
        for name in line.rows
    ]
    if any(mean is not None and mean > OFF_THE_ROAD_M for mean in means):
        marks += f"; means beyond {OFF_THE_ROAD_M:g} m are written at the edge"
    return (
        f"Mean lateral RMSE of every row with its 95 % interval {drawn}, on a logarithmic axis{marks}. Rows "
        "that are told friction and wind above, those that are not below, each group by its RMSE in the last panel."
    )


def tracking(contest: Contest, paper: dict[str, Any]) -> str:
    """What the first table of a contest holds."""
    return _TRACKING + (_PRINTED if is_quoted([contest], paper) else "")


def lead(results: dict[str, Any], found: list[Contest]) -> str:
    """How much was driven."""
    rows: list[Row] = [
        row for contest in found for line in contest.lines for row in line.rows.values()
    ]
    lines = {line.name for contest in found for line in contest.lines}
    vehicles = dict.fromkeys(contest.vehicle for contest in found)
    said = [
        f"{len(lines)} rows on {len(vehicles)} vehicle{'s' if len(vehicles) != 1 else ''} ({', '.join(vehicles)})",
        f"{_spread(rows, 'episodes')} episodes of {_spread(rows, 'episode_s')} s per row, scenario and seed",
        f"training seeds: {_seeds(rows)}",
    ]
    seconds: Any = results.get("seconds")
    lasted = (
        f" The last run of the command took {number(seconds / 60, 1)} minutes."
        if is_number(seconds)
        else ""
    )
    begin = _INTRODUCED.get(str(dig(results, "config", "name")))
    return " ".join(filter(None, [begin, f"{'; '.join(said)}.{lasted}"]))


def _spread(rows: list[Row], key: str) -> str:
    """What all rows have, or from the least to the most."""
    found = sorted({row[key] for row in rows if is_number(row.get(key))})
    ends = [plain(found[0]), plain(found[-1])] if found else [DASH]
    return " to ".join(dict.fromkeys(ends))


def failures(results: dict[str, Any]) -> list[Block]:
    """What was asked for and did not come out."""
    failed = results.get("failed")
    if not isinstance(failed, dict) or not failed:
        return []
    rows = [[str(name), plain(reason)] for name, reason in failed.items()]
    return [
        Heading(2, "Asked for, but not driven"),
        Table(["Row", "Reason"], rows, prose=True),
    ]


def provenance(results: dict[str, Any]) -> list[Block]:
    """Command, settings, versions, seeds and episodes of every contest."""
    config = results.get("config") or {}
    versions = results.get("versions") or {}
    counts = [
        [
            f"{contest.vehicle}, {contest.sampling or 'no sampling'}",
            name,
            *_counted(contest, name),
        ]
        for contest in contests(results["rows"])
        for name in scenarios(contest)
    ]
    return [
        Heading(2, "How to make it again"),
        Code(_command(config)),
        Heading(3, "What was driven"),
        Table(
            ["Contest", "Scenario", "Episodes", "Seconds each", "Seeds"],
            counts,
            prose=True,
        ),
        Heading(3, "Settings"),
        settings_table(_without_print(config)),
        Heading(3, "Versions"),
        Table(
            ["Package", "Version"],
            [[str(name), plain(one)] for name, one in versions.items()],
            prose=True,
        ),
    ]


def _counted(contest: Contest, name: str) -> list[str]:
    rows = [line.rows[name] for line in contest.lines if name in line.rows]
    return [_spread(rows, "episodes"), _spread(rows, "episode_s"), _seeds(rows)]


def _seeds(rows: list[Row]) -> str:
    """All seeds of all rows."""
    found = {seed for row in rows for seed in row.get("seeds") or [] if is_number(seed)}
    return ", ".join(map(plain, sorted(found))) or DASH


def _command(config: dict[str, Any]) -> str:
    """The command line: as recorded, else the experiment that the comparison is named after."""
    if isinstance(config.get("command"), str):
        return config["command"]
    name = config.get("name")
    named = [f"+experiment={name}"] if name not in (None, "", "default") else []
    return shlex.join(["python", "-m", "sfkd_jax.compare", *named])


def _without_print(config: dict[str, Any]) -> dict[str, Any]:
    """Settings without the paper's numbers, which stand in the tables."""
    comparison = config.get("comparison")
    kept = (
        {key: value for key, value in comparison.items() if key != "paper"}
        if isinstance(comparison, dict)
        else None
    )
    return config if kept is None else config | {"comparison": kept}
