"""Sentences: what a run's numbers say, and what they do not say."""

from __future__ import annotations

import re
import shlex
from typing import Any

from sfkd_jax.artefacts import identity
from sfkd_jax.reporting._numbers import (
    DASH,
    dig,
    interval,
    is_number,
    mean_std,
    number,
    plain,
    short,
    upper,
)
from sfkd_jax.reporting._style import label, scenario_label
from sfkd_jax.reporting._tables import PAPER_RMSE_M


def command(door: str, settings: dict[str, Any]) -> str:
    """The command line that opens a door for this run."""
    name, model = settings.get("experiment"), model_of(settings)
    parts = ["python", "-m", f"sfkd_jax.{door}"]
    if dig(settings, "dataset", "contents"):
        parts += ["dataset=files", "dataset.path=LOGS"]
        parts += [f"name={name}"] if name not in (None, "", "default") else []
    else:
        parts += (
            _of_experiment(str(name), settings)
            if name not in (None, "", "default")
            else []
        )
    parts += [f"model={model}"] if model != "sfkd" else []
    return shlex.join([*parts, f"seed={plain(settings.get('seed', 0))}"])


def _of_experiment(name: str, settings: dict[str, Any]) -> list[str]:
    """An experiment; of a job of a sweep, called experiment/key=value,..., also its settings and its name."""
    words = []
    for key, _, spelled in (
        word.partition("=") for word in name.partition("/")[2].split(",") if "=" in word
    ):
        words.append(
            f"{key}={value if isinstance(value := dig(settings, *key.split('.')), list) else spelled}"
        )
    escaped = re.sub("([=,])", r"\\\1", name)  # = and , mean something to Hydra
    return (
        [f"+experiment={name.split('/')[0]}", *words, f"name={escaped}"]
        if words
        else [f"+experiment={name}"]
    )


def model_of(settings: dict[str, Any]) -> str:
    """Name of the system a run trained, as in results.json."""
    return str(
        dig(settings, "model", "system") or dig(settings, "model", "name") or "sfkd"
    )


def headline(
    blocks: list[list[dict[str, Any]]], settings: dict[str, Any]
) -> list[dict[str, Any]]:
    """The block the summary speaks of: the run's own scenario, else the last; feedback, then its controller first."""
    experiment = str(settings.get("experiment"))
    own = [
        block
        for block in blocks
        if experiment.startswith(str(block[0].get("scenario")))
    ] or blocks
    last = (
        [
            block
            for block in own
            if block[0].get("scenario") == own[-1][0].get("scenario")
        ]
        if own
        else []
    )
    feedback = [
        block
        for block in last
        if any(row.get("sampling") == "feedback" for row in block)
    ]
    same = [
        block
        for block in feedback or last
        if any(_own_controller(row, settings) for row in block)
    ]
    return (same or feedback or last or [[]])[0]


def _own_controller(row: dict[str, Any], settings: dict[str, Any]) -> bool:
    """Whether a row drove with the controller that the run was made with."""
    own = settings.get("controller") or {}
    usual = identity(
        {"controller": own.get("name")}
        | {key: own[key] for key in ("planner",) if key in own}
    )
    return all(identity(row)[key] == usual[key] for key in ("controller", "planner"))


def row_of(block: list[dict[str, Any]], system: str) -> dict[str, Any]:
    """The row of a system in a block, preferring the one that sees e; empty if there is none."""
    rows = [row for row in block if row.get("system") == system]
    return next(
        (row for row in rows if row.get("env") == "measured"), rows[0] if rows else {}
    )


def summary(
    settings: dict[str, Any],
    block: list[dict[str, Any]],
    certificate: dict[str, Any] | None,
    metrics: list[dict[str, Any]],
) -> str:
    """What was trained, what is certified and how well it drives, in one paragraph."""
    model, vehicle = model_of(settings), dig(settings, "vehicle", "name")
    plant = f" on the {vehicle} vehicle" if vehicle else ""
    plant = " from logged drives" if dig(settings, "dataset", "contents") else plant
    steps = dig(metrics[-1], "step") if metrics else None
    trained = f" for {short(steps, 9)} steps" if is_number(steps) else ""
    sentences = [
        f"{label(model)} was trained{plant}{trained} (seed {plain(settings.get('seed'))})."
    ]
    if holds(certificate):
        alpha = upper(dig(certificate, "alpha"))
        sentences.append(
            f"Its latent step is certified to contract, α ≤ {alpha} for every environment in the box below."
        )
    elif certificate is not None:
        sentences.append("It carries no valid certificate.")
    return " ".join([*sentences, *_driving(model, block)])


def _driving(model: str, block: list[dict[str, Any]]) -> list[str]:
    """How well the model's own row drives, beside oracle, nominal and whoever did better."""
    own, oracle, nominal = (
        row_of(block, name) for name in (model, "oracle", "nominal")
    )
    mean = dig(own, "rmse_m", "mean")
    if not is_number(mean):
        return []
    bounds = interval(dig(own, "rmse_m", "ci95"))
    within = f" (95 % interval {bounds})" if bounds != DASH else ""
    beside = []
    if is_number(dig(oracle, "rmse_m", "mean")):
        beside.append(
            f"{number(oracle.get('rmse_m'))} m for the oracle, which plans with the true vehicle"
        )
    if is_number(dig(nominal, "rmse_m", "mean")):
        beside.append(
            f"{number(nominal.get('rmse_m'))} m for the nominal model, which knows neither friction nor wind"
        )
    others = f", beside {', and '.join(beside)}" if beside else ""
    where = scenario_label(str(own.get("scenario")))
    said = [
        f"In scenario {where} it follows the path to a lateral RMSE of {number(mean)} m{within}{others}."
    ]
    if is_number(own.get("ratio_to_oracle")):
        said.append(
            f"Its RMSE is {number(own['ratio_to_oracle'], 2)} times the oracle's."
        )
    rivals = [row for row in block if row.get("system") not in (model, "oracle")]
    better = [
        row
        for row in rivals
        if is_number(dig(row, "rmse_m", "mean")) and row["rmse_m"]["mean"] < mean
    ]
    if better:
        best = min(better, key=lambda row: row["rmse_m"]["mean"])
        said.append(
            f"{label(str(best['system']))} does better here, with {number(best['rmse_m'])} m."
        )
    return said


def holds(certificate: dict[str, Any] | None) -> bool:
    """Whether a certificate says that it is valid, with a contraction factor below one."""
    alpha = dig(certificate, "alpha")
    return dig(certificate, "valid") is True and is_number(alpha) and alpha < 1


def paper_note(block: list[dict[str, Any]]) -> str | None:
    """The paper's SFKD figure beside ours, for a scenario for which it reports one."""
    scenario, own = str(block[0].get("scenario")), row_of(block, "sfkd")
    if scenario not in PAPER_RMSE_M or not own:
        return None
    mean, std = PAPER_RMSE_M[scenario]
    return (
        f"SFKD in {scenario_label(scenario)}: {mean_std(own.get('rmse_m'))} m in this run; {mean:.3f} ± {std:.3f} m "
        "reported by the paper, other simulator. They are not measurements of the same thing."
    )


def violation_words(blocks: list[list[dict[str, Any]]]) -> str:
    """What V0, V1 and V2 count."""
    records = [dig(row, "violation") for block in blocks for row in block]
    threshold, level, segments = (
        next((record[key] for record in records if is_number(dig(record, key))), None)
        for key in ("v2_threshold_m", "v1_level", "segments")
    )
    return (
        f"Drives are cut into {short(segments)} segments as long as a calibration drive, and predicted from true "
        "states along them. V0 is the share of steps at which the latent error exceeds the certified Rₖ although no "
        "one-step error exceeded d̄; the theorem says 0. V1 is the share of segments in which any error of position, "
        f"yaw or body state leaves the tube; the level of the tubes, {short(level)}, is promised for drives like those "
        "of calibration, and these are others. The certified tube follows from α and one-step errors, the conformal "
        "one from errors measured at every step ahead. V2 is the share of windows in which the position error "
        f"exceeds {number(threshold, 2)} m, a mark that is the same for every row."
    )
