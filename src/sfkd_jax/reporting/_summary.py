"""The head and the foot of a page: summary, key figures, settings and commands."""

from __future__ import annotations

import re
import shlex
from typing import Any

from sfkd_jax.evaluation.formats import DASH, dig, is_number, plain, short
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.reporting.blocks import Block, Code, Heading, Text, Tiles
from sfkd_jax.reporting.rows import model_of, row_of
from sfkd_jax.reporting.run import Run, holds
from sfkd_jax.reporting.style import label, scenario_label
from sfkd_jax.reporting.tables import named_values
from sfkd_jax.reporting.texts import fill, text

_REFERENCES = ("oracle", "nominal")


def command(name: str, settings: dict[str, Any]) -> str:
    """The command line that runs a command for this run."""
    experiment, model = str(settings.get("experiment") or "default"), model_of(settings)
    named = experiment != "default"
    words = ["python", "-m", f"sfkd_jax.{name}"]
    if dig(settings, "dataset", "contents"):
        words += ["dataset=files", "dataset.path=LOGS"]
        words += [f"name={experiment}"] if named else []
    elif named:
        words += _of_experiment(experiment, settings)
    words += [f"model={model}"] if model != "sfkd" else []
    return shlex.join([*words, f"seed={plain(settings.get('seed', 0))}"])


def _of_experiment(name: str, settings: dict[str, Any]) -> list[str]:
    """The arguments of an experiment.

    A job of a sweep is called experiment/key=value,... and also needs its own settings
    and its name.
    """
    base, _, job = name.partition("/")
    words = []
    for key, given, spelled in (word.partition("=") for word in job.split(",")):
        value = dig(settings, *key.split("."))
        shown = value if isinstance(value, list) else spelled
        words += [f"{key}={shown}"] if given else []
    if not words:
        return [f"+experiment={name}"]
    escaped = re.sub("([=,])", r"\\\1", name)  # Hydra parses = and ,
    return [f"+experiment={base}", *words, f"name={escaped}"]


def summary(run: Run) -> list[Block]:
    """What was trained, what is certified, how well it drives, and key figures."""
    vehicle, seed = dig(run.settings, "vehicle", "name"), run.settings.get("seed")
    source = f" on the {vehicle} vehicle" if vehicle else ""
    if dig(run.settings, "dataset", "contents"):
        source = " from logged drives"
    steps = dig(run.log, "-1", "step")
    trained = f" for {short(steps, 9)} steps" if is_number(steps) else ""
    words = [f"{label(run.system)} was trained{source}{trained} (seed {plain(seed)})."]
    if holds(run.certificate):
        words.append(text("summary.certified", run.certificate))
    elif run.certificate is not None:
        words.append(text("summary.not_certified"))
    words += _driving(run.system, run.headline)
    return [Text(" ".join(words), kind="lead"), *_tiles(run)]


def _rmse(row: Row) -> float | None:
    mean = dig(row, "rmse_m", "mean")
    return mean if is_number(mean) else None


def _driving(model: str, group: list[Row]) -> list[str]:
    """The RMSE of the model, beside oracle, nominal and the best system."""
    own, mean = row_of(group, model), _rmse(row_of(group, model))
    if mean is None:
        return []
    rows = {name: row_of(group, name) for name in _REFERENCES}
    rated = {name: row for name, row in rows.items() if _rmse(row) is not None}
    others = [text(f"summary.{name}", row) for name, row in rated.items()]
    words = [
        text(
            "summary.driving",
            own,
            where=scenario_label(str(own.get("scenario"))),
            within=text("summary.interval", own),
            beside=f", beside {', and '.join(others)}" if others else "",
        )
    ]
    if is_number(own.get("ratio_to_oracle")):
        words.append(text("summary.ratio", own))
    rivals = [row for row in group if row.get("system") not in (model, "oracle")]
    means = [row for row in rivals if _rmse(row) is not None]
    best = min(means, key=lambda row: row["rmse_m"]["mean"], default=own)
    if best["rmse_m"]["mean"] < mean:
        words.append(text("summary.better", best, name=label(str(best["system"]))))
    return words


def _tiles(run: Run) -> list[Block]:
    """The key figures of a run."""
    valid = run.certificate if holds(run.certificate) else None
    own, ahead = row_of(run.headline, run.system), dig(run.errors, "position_rmse_m")
    sources = [
        ("Certified α", valid, "{alpha:upper}"),
        ("Certified corridor", valid, "± {corridor.corridor_m:upper} m"),
    ]
    for system in (run.system, *_REFERENCES):
        row = row_of(run.headline, system)
        name = f"{scenario_label(str(row.get('scenario')))} RMSE, {label(system)}"
        sources.append((name, row, "{rmse_m:number} m"))
    error = f"Error {len(ahead or [])} steps ahead"
    sources += [
        (error, run.errors, "{position_rmse_m.-1:number2} m"),
        ("Control step, median", own, "{act_ms.p50:number1} ms"),
    ]
    items = [(name, fill(template, record)) for name, record, template in sources]
    known = [item for item in items if DASH not in item[1]]
    return [Tiles(known)] if known else []


def provenance(run: Run) -> list[Block]:
    """Settings, versions of packages, and the commands that make this run again."""
    used, usual = run.command, command("train", run.settings)
    trains = isinstance(used, str) and "sfkd_jax.train" in used
    evaluates = isinstance(used, str) and not trains
    return [
        Heading(2, "How to make it again"),
        Text(text("commands.all")),
        Code(used if trains else usual),
        *([Text(text("commands.evaluated")), Code(used)] if evaluates else []),
        Text(text("commands.report")),
        Code(command("report", run.settings)),
        Heading(3, "Settings"),
        named_values(("Group", "Settings"), run.settings),
        Heading(3, "Versions"),
        named_values(("Package", "Version"), run.versions)
        if run.versions and isinstance(run.versions, dict)
        else Text(text("commands.no_versions")),
    ]
