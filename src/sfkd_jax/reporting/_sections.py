"""The sections of a report but for driving: each takes what was read and says, shows or misses its part."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax.reporting._blocks import (
    Block,
    Code,
    Heading,
    Missing,
    Table,
    Text,
    Tiles,
    picture,
)
from sfkd_jax.reporting._certificate_words import certificate_words
from sfkd_jax.reporting._curves import learning, open_loop
from sfkd_jax.reporting._numbers import dig, is_number, number, plain, short, upper
from sfkd_jax.reporting._scene import scenes_of
from sfkd_jax.reporting._style import label, scenario_label
from sfkd_jax.reporting._tables import (
    certificate_table,
    open_loop_table,
    settings_table,
)
from sfkd_jax.reporting._tube import tube, tube_on_drive
from sfkd_jax.reporting._words import command, holds, model_of, row_of


def tiles(
    settings: dict[str, Any],
    head: list[dict[str, Any]],
    errors: dict[str, Any] | None,
    certificate: dict[str, Any] | None,
) -> list[Block]:
    """The few figures a reader looks for first."""
    items = (
        [("Certified α", upper(dig(certificate, "alpha")))]
        if holds(certificate)
        else []
    )
    if holds(certificate) and is_number(dig(certificate, "corridor", "corridor_m")):
        items.append(
            (
                "Certified corridor",
                f"± {upper(dig(certificate, 'corridor', 'corridor_m'))} m",
            )
        )
    for system in (model_of(settings), "oracle", "nominal"):
        mean = dig(row_of(head, system), "rmse_m", "mean")
        if is_number(mean):
            where = scenario_label(str(head[0].get("scenario")))
            items.append((f"{where} RMSE, {label(system)}", f"{number(mean)} m"))
    miss = (dig(errors, "position_rmse_m") or [None])[-1]
    if is_number(miss):
        items.append(
            (
                f"Error {len(dig(errors, 'position_rmse_m'))} steps ahead",
                f"{number(miss, 2)} m",
            )
        )
    step = dig(row_of(head, model_of(settings)), "act_ms", "p50")
    if is_number(step):
        items.append(("Control step, median", f"{number(step, 1)} ms"))
    return [Tiles(items)] if items else []


def certified(
    run: Path,
    certificate: dict[str, Any] | None,
    errors: dict[str, Any] | None,
    settings: dict[str, Any],
    place: Path,
) -> list[Block]:
    """The certificate in words, its tube by step and on a drive, and all of its numbers."""
    blocks: list[Block] = [Heading(2, "What is certified")]
    if certificate is None:
        return [*blocks, Missing("certificate.json", command("certify", settings))]
    blocks += certificate_words(certificate)
    radii = dig(certificate, "tube", "latent") or []
    if holds(certificate) and radii and all(map(is_number, radii)):
        caption = (
            f"Radius Rₖ of the latent prediction error up to {len(radii)} steps ahead."
        )
        limit, alpha = (
            upper(dig(certificate, "tube", "ultimate")),
            upper(certificate["alpha"]),
        )
        blocks.append(picture(place, "tube", caption, tube, radii, limit, alpha))
        position = dig(certificate, "tube", "physical", "position_m") or []
        drives = [
            one
            for one in scenes_of(run)
            if len(one.states.get(model_of(settings), ())) > len(position)
        ]
        if (
            drives
            and len(position) > 1
            and all(is_number(radius) and radius > 0 for radius in position)
        ):
            measured = dig(errors, "position_rmse_m") or []
            drawn = (drives[0], model_of(settings), position, measured)
            blocks.append(picture(place, "tube_on_drive", _TUBE, tube_on_drive, *drawn))
    return [*blocks, certificate_table(certificate)]


_TUBE = (
    "The tube on a drive, in true scale and turned so that the car drives to the right. A prediction that starts at "
    "the dot lies, k steps later, in the disc about the k-th state of the blue line, as long as no one-step error "
    "exceeds d̄; every disc is drawn over the larger ones, the darkest is k = 1. Grey: the road. Below: the radius of "
    "the discs on a logarithmic axis, beside how far predictions missed on drives that training never saw. The proof "
    "is about all states and environments at once; the distance between the two lines is its price."
)


def predicting(
    errors: dict[str, Any] | None, settings: dict[str, Any], place: Path
) -> list[Block]:
    blocks: list[Block] = [Heading(2, "How it predicts")]
    if not dig(errors, "steps"):
        return [*blocks, Missing("open_loop.json", command("train", settings))]
    caption = "Error of predictions without feedback, root mean square over held-out trajectories."
    blocks.append(picture(place, "open_loop", caption, open_loop, errors))
    note = f"Over {short(dig(errors, 'trajectories'))} trajectories that training never saw."
    return [*blocks, open_loop_table(errors or {}), Text(note, kind="note")]


def training(
    metrics: list[dict[str, Any]], settings: dict[str, Any], place: Path
) -> list[Block]:
    blocks: list[Block] = [Heading(2, "How it was trained")]
    if not metrics:
        return [*blocks, Missing("metrics.jsonl", command("train", settings))]
    caption = (
        "Loss on training windows and on validation trajectories, by optimisation step."
    )
    return [*blocks, picture(place, "learning", caption, learning, metrics)]


def provenance(settings: dict[str, Any], versions: Any, asked: Any) -> list[Block]:
    """Settings, versions, and the commands that make this run again; `asked`: the command that drove it."""
    walked = isinstance(asked, str) and "sfkd_jax.train" in asked
    driven = (
        [Text("Its results were driven by:"), Code(asked)]
        if isinstance(asked, str) and not walked
        else []
    )
    found = (
        [[str(name), plain(version)] for name, version in versions.items()]
        if isinstance(versions, dict)
        else []
    )
    return [
        Heading(2, "How to make it again"),
        Text("This command walks from nothing to this page:"),
        Code(asked if walked else command("train", settings)),
        *driven,
        Text("This one only draws the page again from the files of the run:"),
        Code(command("report", settings)),
        Heading(3, "Settings"),
        settings_table(settings),
        Heading(3, "Versions"),
        Table(["Package", "Version"], found, prose=True)
        if found
        else Text("Not recorded in policy.json."),
    ]
