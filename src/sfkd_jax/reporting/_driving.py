"""The section on what was driven: scores, pictures, planner, violations, and the remaining measures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax.reporting._blocks import Block, Heading, Missing, Text, picture
from sfkd_jax.reporting._driven import deviation, spread, steering
from sfkd_jax.reporting._numbers import dig, is_number, short
from sfkd_jax.reporting._scene import Scene, scenes_of
from sfkd_jax.reporting._tables import (
    block_title,
    closed_loop,
    closed_loop_more,
    planner_table,
    violation_table,
)
from sfkd_jax.reporting._track import EXAGGERATION, track
from sfkd_jax.reporting._violations import disturbed, violations
from sfkd_jax.reporting._words import command, headline, paper_note, violation_words


def driving(
    run: Path, rows: list[list[dict[str, Any]]], settings: dict[str, Any], place: Path
) -> list[Block]:
    """Closed loop: the table the summary speaks of, the pictures, then every other table."""
    blocks: list[Block] = [Heading(2, "How it drives")]
    head = headline(rows, settings)
    if (
        not head
        and dig(settings, "vehicle", "name") == "own"
        and not dig(settings, "vehicle", "step")
    ):
        return [
            *blocks,
            Text(
                "Not driven: the robot is known from logs alone, so there is nothing here to drive."
            ),
        ]
    if head:
        blocks += [*_scores(head), Text(_EXPLAINED, kind="note")]
    else:
        blocks.append(Missing("results.json", command("evaluate", settings)))
    scenes = scenes_of(run)
    if not scenes:
        blocks.append(Missing("episodes.npz", command("evaluate", settings)))
    for scene in scenes:
        blocks += _scene_pictures(scene, place, full=scene is scenes[0])
    for block in rows:
        blocks += _scores(block) if block is not head else []
    blocks += _planning(rows, settings)
    blocks += _violating(rows, place)
    more = [(block_title(block), closed_loop_more(block)) for block in rows]
    shown = [
        [Text(title, kind="sub"), table]
        for title, table in more
        if len(table.header) > 1
    ]
    return [
        *blocks,
        *([Heading(3, "More measures")] if shown else []),
        *(piece for pair in shown for piece in pair),
    ]


_EXPLAINED = (
    "RMSE is of the lateral deviation of the true state from the path, one number per episode. Mean, "
    "standard deviation and 95 % interval are over the same episodes for every system. Steering rate is "
    "the mean of its absolute value. The oracle plans with the true vehicle; the nominal model is told "
    "neither friction nor wind."
)


def _scores(block: list[dict[str, Any]]) -> list[Block]:
    note = paper_note(block)
    table = [Heading(3, block_title(block)), closed_loop(block)]
    return [*table, Text(note, "Beside the paper.", "note")] if note else table


def _scene_pictures(scene: Scene, place: Path, *, full: bool) -> list[Block]:
    """Deviation of one scenario; with `full` also all episodes, the road from above and the steering."""
    name = scene.label
    caption = (
        f"{name}, first episode: signed lateral deviation from the path, left positive. Dashed lines mark "
        "where friction and wind switch; below, what they are."
    )
    stem = scene.stem
    blocks: list[Block] = [
        picture(place, f"deviation_{stem}", caption, deviation, scene)
    ]
    if not full:
        return blocks
    caption = (
        f"{name}, all episodes: absolute lateral deviation over the whole duration."
    )
    blocks.append(picture(place, f"episodes_{stem}", caption, spread, scene))
    if scene.path is not None and scene.states:
        caption = (
            f"{name}, first episode: the road in true scale, and the stretch in the ring, where "
            f"deviations are largest, with deviations (not the road) drawn {EXAGGERATION} times as wide."
        )
        blocks.append(picture(place, f"track_{stem}", caption, track, scene))
    if scene.controls:
        caption = f"{name}, first episode: steering commands over ten seconds around that stretch."
        blocks.append(picture(place, f"steering_{stem}", caption, steering, scene))
    return blocks


def _planning(
    rows: list[list[dict[str, Any]]], settings: dict[str, Any]
) -> list[Block]:
    """Effective sample size and solve times, where any was measured."""
    tables = [(block_title(block), planner_table(block)) for block in rows]
    shown = [
        [Text(title, kind="sub"), table]
        for title, table in tables
        if len(table.header) > 1
    ]
    said = [Text(_planner_words(settings), kind="note")] if shown else []
    return [
        *(
            [Heading(3, "Planner: effective sample size and solve time")]
            if shown
            else []
        ),
        *(piece for pair in shown for piece in pair),
        *said,
    ]


def _planner_words(settings: dict[str, Any]) -> str:
    """What the effective sample size and the solve times are of."""
    search = dig(settings, "controller", "planner") or "mppi"
    drawn, ahead = (
        dig(settings, "controller", search, key) for key in ("num_samples", "horizon")
    )
    period = dig(settings, "vehicle", "dt")
    text = "Effective samples: 1 / Σ w² of the weights that the planner gives its samples, median over all steps"
    text += (
        f"; it draws {short(drawn)} over {short(ahead)} steps"
        if is_number(drawn) and is_number(ahead)
        else ""
    )
    text += ". Control step: everything from observation to control for one car, compiled, on the machine that drove"
    return text + (
        f"; a new control is due every {short(1e3 * period)} ms."
        if is_number(period)
        else "."
    )


def _violating(rows: list[list[dict[str, Any]]], place: Path) -> list[Block]:
    """How often predictions left what is claimed about them, and Figure 2 where side forces were injected."""
    blocks: list[Block] = []
    measured = [
        block
        for block in rows
        if any(is_number(dig(row, "violation", "segments")) for row in block)
    ]
    figures = (
        f"figure2{suffix}"
        for suffix in ["", *(f"_{count}" for count in range(2, len(rows) + 1))]
    )
    for block in measured:
        blocks += [
            Heading(3, f"Violations: {block_title(block)}"),
            violation_table(block),
        ]
        pushed = disturbed(block)
        if pushed:
            blocks.append(picture(place, next(figures), _FIGURE2, violations, pushed))
    return [*blocks, Text(violation_words(measured), kind="note")] if measured else []


_FIGURE2 = (
    "Violations while a side force that nobody measures pushes the car: redrawn every second, evenly up to the value "
    "on the axis to either side. Circles: conformal tubes, all at one level. Squares: the certified tube. Crosses: "
    "steps at which the theorem fails. Dashed: the share that the level of the tubes allows. Right: the position "
    "radius of each tube, mean over the horizon; a tube that is wide enough is never left."
)
