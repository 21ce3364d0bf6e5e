"""The sections of a report: each takes what was read and says, shows or misses its part."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sfkd_jax.reporting._blocks import Block, Code, Heading, Missing, Picture, Table, Text, Tiles
from sfkd_jax.reporting._curves import learning, open_loop, tube
from sfkd_jax.reporting._driven import deviation, spread, steering
from sfkd_jax.reporting._numbers import dig, is_number, number, plain, short, upper
from sfkd_jax.reporting._scene import Scene, read_scenes, switches
from sfkd_jax.reporting._style import label, save
from sfkd_jax.reporting._tables import (
    block_title,
    certificate_table,
    closed_loop,
    closed_loop_more,
    open_loop_table,
    settings_table,
    violation_table,
)
from sfkd_jax.reporting._track import EXAGGERATION, track
from sfkd_jax.reporting._violations import disturbed, violations
from sfkd_jax.reporting._words import (
    certificate_words,
    command,
    headline,
    holds,
    model_of,
    paper_note,
    row_of,
    violation_words,
)


def _picture(place: Path, name: str, caption: str, draw: Callable[..., Figure], *inputs: Any) -> Picture:
    return Picture(save(place / f"{name}.png", draw, *inputs), caption)


def tiles(
    settings: dict[str, Any],
    head: list[dict[str, Any]],
    errors: dict[str, Any] | None,
    certificate: dict[str, Any] | None,
) -> list[Block]:
    """The few figures a reader looks for first."""
    items = [("Certified α", upper(dig(certificate, "alpha")))] if holds(certificate) else []
    for system in (model_of(settings), "oracle", "nominal"):
        mean = dig(row_of(head, system), "rmse_m", "mean")
        if is_number(mean):
            where = str(head[0].get("scenario")).upper()
            items.append((f"{where} RMSE, {label(system)}", f"{number(mean)} m"))
    miss = (dig(errors, "position_rmse_m") or [None])[-1]
    if is_number(miss):
        items.append((f"Error {len(dig(errors, 'position_rmse_m'))} steps ahead", f"{number(miss, 2)} m"))
    return [Tiles(items)] if items else []


def driving(run: Path, rows: list[list[dict[str, Any]]], settings: dict[str, Any], place: Path) -> list[Block]:
    """Closed loop: the table the summary speaks of, the pictures, then every other table."""
    blocks: list[Block] = [Heading(2, "How it drives")]
    head = headline(rows, settings)
    if not head and dig(settings, "vehicle", "name") == "own" and not dig(settings, "vehicle", "step"):
        return [*blocks, Text("Not driven: the robot is known from logs alone, so there is nothing here to drive.")]
    if head:
        blocks += [*_scores(head), Text(_EXPLAINED, kind="note")]
    else:
        blocks.append(Missing("results.json", command("evaluate", settings)))
    episodes = run / "episodes.npz"
    scenes = sorted(
        read_scenes(episodes).values() if episodes.exists() else [],
        key=lambda scene: len(switches(scene.envs)),
        reverse=True,
    )
    if not scenes:
        blocks.append(Missing("episodes.npz", command("evaluate", settings)))
    for scene in scenes:
        blocks += _scene_pictures(scene, place, full=scene is scenes[0])
    for block in rows:
        blocks += _scores(block) if block is not head else []
    blocks += _violating(rows, place)
    more = [(block_title(block), closed_loop_more(block)) for block in rows]
    shown = [[Text(title, kind="sub"), table] for title, table in more if len(table.header) > 1]
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
    name = scene.name.upper()
    caption = (
        f"{name}, first episode: signed lateral deviation from the path, left positive. Dashed lines mark "
        "where friction and wind switch; below, what they are."
    )
    stem = "".join(letter if letter.isalnum() else "_" for letter in scene.name)
    blocks: list[Block] = [_picture(place, f"deviation_{stem}", caption, deviation, scene)]
    if not full:
        return blocks
    caption = f"{name}, all episodes: absolute lateral deviation over the whole duration."
    blocks.append(_picture(place, f"episodes_{stem}", caption, spread, scene))
    if scene.path is not None and scene.states:
        caption = (
            f"{name}, first episode: the road in true scale, and the stretch in the ring, where "
            f"deviations are largest, with deviations (not the road) drawn {EXAGGERATION} times as wide."
        )
        blocks.append(_picture(place, f"track_{stem}", caption, track, scene))
    if scene.controls:
        caption = f"{name}, first episode: steering commands over ten seconds around that stretch."
        blocks.append(_picture(place, f"steering_{stem}", caption, steering, scene))
    return blocks


def _violating(rows: list[list[dict[str, Any]]], place: Path) -> list[Block]:
    """How often predictions left what is claimed about them, and Figure 2 where side forces were injected."""
    blocks: list[Block] = []
    measured = [block for block in rows if any(is_number(dig(row, "violation", "segments")) for row in block)]
    figures = (f"figure2{suffix}" for suffix in ["", *(f"_{count}" for count in range(2, len(rows) + 1))])
    for block in measured:
        blocks += [Heading(3, f"Violations: {block_title(block)}"), violation_table(block)]
        pushed = disturbed(block)
        if pushed:
            blocks.append(_picture(place, next(figures), _FIGURE2, violations, pushed))
    return [*blocks, Text(violation_words(measured), kind="note")] if measured else []


_FIGURE2 = (
    "Violations while a side force that nobody measures pushes the car: redrawn every second, evenly up to the value "
    "on the axis to either side. Circles: conformal tubes, all at one level. Squares: the certified tube. Crosses: "
    "steps at which the theorem fails. Dashed: the share that the level of the tubes allows. Right: the position "
    "radius of each tube, mean over the horizon; a tube that is wide enough is never left."
)


def certified(certificate: dict[str, Any] | None, settings: dict[str, Any], place: Path) -> list[Block]:
    blocks: list[Block] = [Heading(2, "What is certified")]
    if certificate is None:
        return [*blocks, Missing("certificate.json", command("certify", settings))]
    blocks += certificate_words(certificate)
    radii = dig(certificate, "tube", "latent") or []
    if holds(certificate) and radii and all(map(is_number, radii)):
        caption = f"Radius Rₖ of the latent prediction error up to {len(radii)} steps ahead."
        limit, alpha = upper(dig(certificate, "tube", "ultimate")), upper(certificate["alpha"])
        blocks.append(_picture(place, "tube", caption, tube, radii, limit, alpha))
    return [*blocks, certificate_table(certificate)]


def predicting(errors: dict[str, Any] | None, settings: dict[str, Any], place: Path) -> list[Block]:
    blocks: list[Block] = [Heading(2, "How it predicts")]
    if not dig(errors, "steps"):
        return [*blocks, Missing("open_loop.json", command("train", settings))]
    caption = "Error of predictions without feedback, root mean square over held-out trajectories."
    blocks.append(_picture(place, "open_loop", caption, open_loop, errors))
    note = f"Over {short(dig(errors, 'trajectories'))} trajectories that training never saw."
    return [*blocks, open_loop_table(errors or {}), Text(note, kind="note")]


def training(metrics: list[dict[str, Any]], settings: dict[str, Any], place: Path) -> list[Block]:
    blocks: list[Block] = [Heading(2, "How it was trained")]
    if not metrics:
        return [*blocks, Missing("metrics.jsonl", command("train", settings))]
    caption = "Loss on training windows and on validation trajectories, by optimisation step."
    return [*blocks, _picture(place, "learning", caption, learning, metrics)]


def provenance(settings: dict[str, Any], versions: Any) -> list[Block]:
    """Settings, versions, and the commands that make this run again."""
    found = [[str(name), plain(version)] for name, version in versions.items()] if isinstance(versions, dict) else []
    return [
        Heading(2, "How to make it again"),
        Text("This command walks from nothing to this page:"),
        Code(command("train", settings)),
        Text("This one only draws the page again from the files of the run:"),
        Code(command("report", settings)),
        Heading(3, "Settings"),
        settings_table(settings),
        Heading(3, "Versions"),
        Table(["Package", "Version"], found, prose=True) if found else Text("Not recorded in policy.json."),
    ]
