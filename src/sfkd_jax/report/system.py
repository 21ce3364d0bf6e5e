"""The page of a system that is no car, from what the files of its run say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfkd_jax import store
from sfkd_jax.evaluation.formats import dig, interval, percent, plain, short
from sfkd_jax.policy import CERTIFICATE, SYSTEM_KIND, system_file
from sfkd_jax.report import style
from sfkd_jax.report.pages import Part, Picture, Section, write_page
from sfkd_jax.report.sections import (
    PROOF,
    certificate_document,
    empty_folder,
    holds,
    learned,
    made_with,
    read_optional,
)
from sfkd_jax.report.tables import record_table
from sfkd_jax.settings import Values
from sfkd_jax.systems import split_label

COMPARISON = "comparison.json"
"""What `train` writes of a system and its rivals."""
FIRST_RUN = "first_run.json"
"""Errors over time in the first run of a comparison."""
_CONTROLLERS = ("policy", "law", "oracle", "nominal")


def write_system_report(run_dir: Path) -> dict[str, Any]:
    """Write `run_dir/report/`: index.html and its figures.

    No number of the run is computed again. All its files but the policy may be missing.

    Returns:
        The paths of the page and of its images.
    """
    home = run_dir / "report"
    file = system_file(run_dir)
    with store.as_artefact_error(home):
        if not file.exists():
            makes = "python -m sfkd_jax.train system=… makes a run"
            raise store.ArtefactError(f"{file} is missing: {makes}")
        images = empty_folder(home / "figures")
        _, manifest = store.read_arrays(file, kind=SYSTEM_KIND)
        settings = manifest["config"]
        certificate = certificate_document(run_dir, manifest)
        sections = [
            Section("Bounds", _bounds(certificate, settings)),
            Section("Runs", _runs(run_dir, certificate, settings, images)),
            Section("Certificate", _certified(certificate, settings)),
            Section("Training", learned(run_dir, images)),
            made_with(settings, manifest.get("versions")),
        ]
        name = plain(dig(settings, "system", "name"))
        return write_page(f"{name}, seed {plain(settings.get('seed'))}", sections, home)


def _bounds(certificate: dict[str, Any], settings: Values) -> list[Part]:
    """Return a table of the bounds of the outputs, and what they hold for."""
    if not holds(certificate):
        reason = plain(certificate.get("reason") or f"{CERTIFICATE} is missing")
        return [f"Nothing is certified for these weights: {reason}."]
    tubes = certificate["tubes"]
    units = _units(settings)
    rows = {
        f"{name} [{units[name]}]": [
            short(bound[part]) for part in ("total", "tube", "nominal", "system")
        ]
        for name, bound in tubes["outputs"].items()
    }
    share = percent(dig(tubes, "coverage", "share"))
    interval_95 = interval(dig(tubes, "coverage", "ci95"))
    return [
        f"With probability {percent(tubes['level'])} all outputs stay within these "
        f"bounds on a new run of {short(dig(tubes, 'conditions', 'duration_s'))} s. "
        f"{tubes['runs']} runs calibrated them; they held in {share} of as many fresh "
        f"ones, 95 % interval {interval_95}.",
        record_table(
            "Output",
            rows,
            "whole bound",
            "tube around the nominal model",
            "nominal model",
            "largest error of the law alone",
        ),
    ]


def _runs(
    run_dir: Path,
    certificate: dict[str, Any],
    settings: Values,
    images: Path,
) -> list[Part]:
    """Return the RMSE of policy and rivals, and their errors in the first run."""
    compared = read_optional(run_dir / COMPARISON)
    first = read_optional(run_dir / FIRST_RUN)
    if not compared or not first:
        return [f"{COMPARISON} is missing: python -m sfkd_jax.train system=… makes it."]
    rows = {
        name: short(compared.get("rmse" if name == "policy" else f"rmse_{name}"))
        for name in _CONTROLLERS
    }
    output, unit = next(iter(_units(settings).items()))
    bounds = {}
    if holds(certificate):
        outputs = certificate["tubes"]["outputs"]
        bounds = {name: bound["total"] for name, bound in outputs.items()}
    dt = settings["system"]["dt"]
    path = images / "first_run.png"
    style.save(path, errors_over_time, first, bounds, _units(settings), dt)
    claimed = percent(compared.get("claimed"))
    return [
        f"The policy claimed a bound in {claimed} of the steps, and was beyond it in "
        f"{plain(compared.get('beyond'))}.",
        record_table("Controller", rows, f"RMSE of {output} [{unit}]"),
        Picture(path, "Errors in the first run"),
    ]


def errors_over_time(
    first: dict[str, Any], bounds: dict[str, float], units: dict[str, str], dt: float
) -> Figure:
    """Draw the size of every output over time, with its certified bound.

    Args:
        first: controller -> output -> |y| at every step.
        bounds: certified bound of each output; {} if nothing is certified.
        units: unit of each output.
        dt: sampling period [s].
    """
    figure = style.canvas(0.9 + 2.0 * len(units))
    panels = figure.subplots(len(units), squeeze=False, sharex=True)[:, 0]
    for axes, (output, unit) in zip(panels, units.items(), strict=True):
        for name in reversed(_CONTROLLERS):
            errors = np.asarray(first[name][output])
            time = dt * np.arange(len(errors))
            axes.plot(time, errors, **style.line("sfkd" if name == "policy" else name))
        if output in bounds:
            axes.axhspan(0.0, bounds[output], **style.BAND)
            axes.axhline(bounds[output], **style.EDGE)
        axes.set_ylabel(f"|{output}| [{unit}]")
        axes.set(ylim=(0.0, None), xlim=(0.0, None))
    panels[-1].set_xlabel("time [s]")
    style.legend(figure, panels[0])
    return figure


def _certified(certificate: dict[str, Any], settings: Values) -> list[Part]:
    """Return what is proved, and the class that the bounds are about."""
    if not holds(certificate):
        return []
    conditions = certificate["tubes"]["conditions"]
    alpha = short(dig(certificate, "proof", "alpha"), 4)
    boxes = {
        f"e: {name}": list(ends)
        for name, ends in settings["system"]["environment"].items()
    }
    for chain, ends in settings["frame"]["reference"]:
        boxes[f"reference: rate of {chain[-1]}"] = list(ends)
    for name, ends in settings["frame"]["ranges"].items():
        boxes[f"reference: {name}"] = list(ends)
    boxes["time between changes of the reference [s]"] = conditions["reference_dwell_s"]
    boxes["time between switches of e [s]"] = conditions["env_dwell_s"]
    return [
        PROOF,
        f"The model contracts at {alpha} a step, which is proved.",
        record_table("Class", boxes, "from", "to"),
    ]


def _units(settings: Values) -> dict[str, str]:
    """Return the unit of each output."""
    labels = dict(map(split_label, settings["system"]["states"]))
    return {
        name: labels[states[0]] or "-"
        for name, states in settings["frame"]["outputs"].items()
    }
