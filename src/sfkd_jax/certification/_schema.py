"""The rule of every entry of a certificate about a policy, without its corridor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from sfkd_jax.certification._certificate import PRECISION
from sfkd_jax.certification._claims import CONSTANTS, decoders, hull_scope, readouts
from sfkd_jax.certification._measured import RESIDUALS, coverage_interval, holds_for
from sfkd_jax.certification._metric_claims import OUTPUTS, ROTATES, keeps_metrics
from sfkd_jax.certification._rules import REPEATED, Follows, Measured, Proved, Rule
from sfkd_jax.certification._tubes import FORMS, tubes
from sfkd_jax.certification._weights import Exported, fingerprint
from sfkd_jax.data import SCENARIOS, sizes_of_parts

Trained: TypeAlias = Any
"""A `policy.TrainedModel`: what a certificate is about."""

ROUNDED = 1e-6
"""Relative tolerance of values that are stored in float32 in one place, and in float64
in another.
"""
SMALLEST = 1e-12
"""Smallest measured length, angle or time that is positive."""
REACH = 100.0
"""How far the ends of the data may be from their centre, in half widths of the middle
99.8 %.
"""
LABELS = (*SCENARIOS, "s1", "s2")
"""Parts of the test runs by name. The last two are halves, in order of generation."""

SECONDS = Measured()
TEXT = Measured(value_type=str)
POSITIVE = Measured(SMALLEST)
COUNT = Measured(1, 10**9, int)
METRIC = {"metric": Proved(), "joint": Proved()}


def document_rules(
    document: Mapping[str, Any], trained: Trained, weights: Exported
) -> dict[str, Any]:
    """Return the rule of every entry that every certificate of the policy has.

    Args:
        document: the certificate.
        trained: the policy.
        weights: its explicit weights.
    """
    lipschitz = document["lipschitz"]
    step = document["attacks"].get("step")
    outputs = [*readouts(weights), *decoders(weights)]
    versions = ("python", "numpy", "jax", "sfkd_jax", "scipy")
    return {
        "valid": Follows(True),
        "policy_sha256": Follows(trained.sha256),
        "weights_sha256": Follows(trained.weights_sha256),
        "params_sha256": Follows(fingerprint(trained.params)),
        "precision": Follows(PRECISION),
        "scope": Follows(hull_scope(weights)),
        **dict.fromkeys(CONSTANTS, Proved()),
        "transport_lipschitz": Follows(1.0),
        "lipschitz": dict.fromkeys(outputs, Proved()),
        "decoder_lipschitz": Follows(lipschitz.get("decoder")),
        "witnesses": dict.fromkeys(("residual", "joint", *decoders(weights)), Proved()),
        "attacks": dict.fromkeys(_attacks(weights, outputs, step), Measured()),
        "attack": Follows(step),
        "tightness": Follows(document["alpha"] / step if step else None),
        "lyapunov": _lyapunov(document["lyapunov"], weights),
        "env_box": _env_box(trained),
        "boxes": _boxes(document, trained),
        "d_bar": _one_step(document["d_bar"], trained),
        "tube": _prediction(document),
        # Either every output has a metric or none: a corridor needs both.
        "outputs": {
            name: _output(document, name)
            for name in OUTPUTS
            if document["outputs"] != {}
        },
        "versions": dict.fromkeys(versions, TEXT),
        "seconds": SECONDS,
        "seconds_proof": SECONDS,
    }


def is_simulated(trained: Trained) -> bool:
    """Return whether the data of the policy were simulated by this package."""
    return "segments" in trained.settings.get("dataset", {})


def covered(
    stated: Mapping[str, Any], trajectories: Rule, runs: Rule
) -> dict[str, Any]:
    """Return the rules of a coverage, with the interval that follows from it.

    Args:
        stated: the entries.
        trajectories: rule of their number.
        runs: rule of the number of independent runs.
    """
    share = stated["coverage"]
    sizes = stated["coverage_trajectories"]
    return {
        "coverage": Measured(0.0, 1.0, share_of=sizes),
        "coverage_ci95": Follows(coverage_interval(share, stated["coverage_runs"])),
        "coverage_trajectories": trajectories,
        "coverage_runs": runs,
    }


def settings_rules(document: Mapping[str, Any]) -> Rule:
    """Return the rules of the settings of the command that made the certificate."""
    corridor = document.get("corridor")
    if not corridor:
        corridor_rules: dict[str, Any] = {
            "runs": COUNT,
            "horizon": COUNT,
            "attack_steps": COUNT,
            "duration": POSITIVE,
            "dwell": [POSITIVE, POSITIVE],
        }
    else:
        # They are stated by the corridor as well.
        corridor_rules = {
            "runs": Follows(corridor["runs"]),
            "horizon": Follows(corridor["shield_horizon"]),
            "attack_steps": Follows(corridor["attack"]["steps"]),
            "duration": Follows(corridor["conditions"]["duration_s"]),
            "dwell": Follows(corridor["conditions"]["dwell_s"]),
        }
    return {
        "level": Follows(document["d_bar"]["level"]),
        "horizon": Follows(len(document["tube"]["latent"])),
        "attack_starts": Measured(0, 10**6, int),
        "corridor": corridor_rules,
    }


def _attacks(weights: Exported, outputs: list[str], step: Any) -> list[str]:
    """Return the names of the attacks on a model.

    Args:
        weights: of the model.
        outputs: names of its outputs.
        step: what the attack on the step reached. Without one there are only attacks
            that need no running model.
    """
    networks = {"residual": weights.residual, **decoders(weights)}
    attacks = [f"{name}_slopes" for name, layers in networks.items() if layers]
    attacks.append("step_slopes")
    if step:
        attacks += ["step", "transport", *outputs]
    return attacks


def _lyapunov(stated: Mapping[str, Any], weights: Exported) -> Rule:
    """Return the rules of the paper's constants, or of the reason for their lack."""
    if not keeps_metrics(weights):
        return {"reason": Follows(ROTATES)}
    if "reason" in stated:
        return {"reason": TEXT}
    root = math.sqrt(stated["condition"])
    return {
        "rho": Proved(),
        "condition": Proved(),
        "alpha": Proved(),
        "c_1": Follows(root),
        "c_2": Follows(root),
        "witness": METRIC,
    }


def _env_box(trained: Trained) -> Rule:
    """Return the rule of E: that of the settings, or for logs that of the data."""
    low = trained.settings["environment"].get("low")
    high = trained.settings["environment"].get("high")
    if low is None or high is None:
        return _box(trained, "env", 1.0)
    return Follows([[*low], [*high]], ROUNDED)


def _box(trained: Trained, part: str, reach: float = REACH) -> list[Any]:
    """Return the rules of the corners of a box of the data.

    A corner is at the half width of the middle 99.8 %, which the policy states, or
    beyond it.

    Args:
        trained: the policy.
        part: of its space: "body", "control" or "env".
        reach: how far a corner may be, in half widths.
    """
    space = trained.settings["space"]
    centre = np.asarray(space[f"{part}_mean"])
    half = np.asarray(space[f"{part}_scale"])
    rounding = ROUNDED * (np.abs(centre) + half)
    # A channel that never moved has the scale 1, and may have no width.
    inner = np.where(half == 1.0, 0.0, half) - rounding
    outer = reach * half + rounding
    lower = (centre - outer, centre - inner)
    upper = (centre + inner, centre + outer)
    if part == "control" and trained.law is not None and is_simulated(trained):
        # ν, κ and v_ref are drawn within limits, which bound the corners.
        data = trained.settings["dataset"]
        largest = np.append(trained.law.perturbation, data["peak_curvature"])
        slowest, fastest = data["speed"]
        lower = (np.append(-largest, slowest) - rounding, lower[1])
        upper = (upper[0], np.append(largest, fastest) + rounding)
    return [Measured(*lower), Measured(*upper)]


def _boxes(document: Mapping[str, Any], trained: Trained) -> Rule:
    """Return the rules of the boxes of the data, and of their names for logs."""
    rules: dict[str, Any] = {
        "state": _box(trained, "body"),
        "control": _box(trained, "control"),
        "env": Follows(document["env_box"], 0.0),
    }
    columns = trained.settings.get("dataset", {}).get("columns")
    if columns:
        # An environment that the policy ignores has no names.
        has_names = document["boxes"]["names"]["env"]
        rules["names"] = Follows(
            {
                "state": [*columns["state"][3:]],
                "control": [*columns["control"]],
                "env": [*columns["environment"]] if has_names else [],
            }
        )
    return rules


def _one_step(d_bar: Mapping[str, Any], trained: Trained) -> Rule:
    """Return the rules of the bounds on single steps, and of their coverage."""
    count = d_bar["trajectories"]
    test = d_bar["coverage_trajectories"]
    rules = {
        "value": Follows(d_bar["one_step"]["latent"]),
        "level": Measured(SMALLEST, count / (count + 1)),
        "trajectories": COUNT,
        "runs": Measured(1, count, int),
        "holds_for": Follows(holds_for(d_bar["runs"], d_bar["level"])),
        **covered(d_bar, COUNT, Measured(1, test, int)),
        "by_scenario": {},
        "one_step": dict.fromkeys(RESIDUALS, Measured()),
        "validation": Measured(),
    }
    if is_simulated(trained):
        rules.update(_simulated_one_step(d_bar, trained))
    return rules


def _simulated_one_step(d_bar: Mapping[str, Any], trained: Trained) -> dict[str, Any]:
    """Return those of the rules that are stricter for simulated data.

    Every simulated segment is a run of its own, and all test runs have a label.
    """
    data = trained.settings["dataset"]
    stated = d_bar["by_scenario"]
    *_, calibration, tested = sizes_of_parts(data["segments"], data["shares"])
    labels = [name for name in LABELS if name in stated]
    sizes = [stated[name]["coverage_trajectories"] for name in labels]
    inside = sum(
        stated[name]["coverage"] * size
        for name, size in zip(labels, sizes, strict=True)
    )
    by_scenario = {"s3": covered(stated["s3"], Follows(tested), Follows(tested))}
    for name, size in zip(labels, sizes, strict=True):
        # What the other labels leave of the test runs.
        rest = Follows(int(tested - (sum(sizes) - size)))
        by_scenario[name] = covered(stated[name], rest, rest)
    return {
        **covered(d_bar, Follows(tested), Follows(tested)),
        "trajectories": Follows(calibration),
        "runs": Follows(calibration),
        "coverage": Follows(inside / tested),
        "by_scenario": by_scenario,
    }


def _prediction(document: Mapping[str, Any]) -> Rule:
    """Return the rules of R_k, its limit, and the radii in metres and radians."""
    tube = document["tube"]
    lipschitz = document["lipschitz"]
    # A decoder gives increments of the pose, which add up with the length of a step.
    has_increments = "decoder" in lipschitz
    derived = tubes(
        alpha=document["alpha"],
        lipschitz=lipschitz,
        one_step=document["d_bar"]["one_step"],
        horizon=len(tube["latent"]),
        largest_increment=tube["largest_increment_m"] if has_increments else None,
    )
    rules: dict[str, Any] = {name: Follows(value) for name, value in derived.items()}
    if has_increments:
        # The length of a step is measured.
        rules["largest_increment_m"] = Measured()
    return rules


def _output(document: Mapping[str, Any], name: str) -> Rule:
    """Return the rules of the metric of an output, and of its bounds and coverage."""
    part = document["outputs"][name]
    runs = document["d_bar"]["coverage_trajectories"]
    intervals = {
        form: coverage_interval(part["coverage"][form], runs) for form in FORMS
    }
    # On every run the bound from the largest disturbance alone is the larger one.
    largest = part["tube"]["asymptotic"] * (1 + REPEATED)
    return {
        "alpha": Proved(),
        "lipschitz": Proved(),
        "witness": METRIC,
        "tube": {
            "asymptotic": POSITIVE,
            "vehicle_to_nominal": Measured(SMALLEST, largest),
        },
        "coverage": dict.fromkeys(FORMS, Measured(0.0, 1.0, share_of=runs)),
        "coverage_ci95": Follows(intervals),
        "coverage_runs": Follows(runs),
    }
