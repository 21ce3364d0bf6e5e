"""Verification of certificates from an untrusted source, without any search.

`schema` gives every entry of a document one of three rules: proved entries are checked
by the trusted core, those that follow are derived again from the policy and from other
entries, and measured ones lie in a range that the policy and their siblings leave. Only
a signature could bind a measured number within its range.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sfkd_jax.certification._alarms import BATCHES
from sfkd_jax.certification._certificate import PRECISION, Certificate, verify
from sfkd_jax.certification._claims import (
    CONSTANTS,
    OUTPUTS,
    ROTATES,
    OutputMetric,
    decoders,
    hull_scope,
    keeps_metrics,
    readouts,
    require_lyapunov,
    require_output_metric,
)
from sfkd_jax.certification._measured import KINDS, coverage_interval, holds_for
from sfkd_jax.certification._tubes import ALONE, FORMS, JOINT, tubes
from sfkd_jax.certification._weights import (
    CertificateStale,
    Exported,
    exported,
    fingerprint,
    one_thread,
    require,
    well_formed,
)
from sfkd_jax.certification.corridor import EXCITATION, LENGTH, drive_class
from sfkd_jax.control import WINDOWS
from sfkd_jax.data import SCENARIOS, sizes_of_parts
from sfkd_jax.scenarios import DRIVES

REPEATED = 1e-9
"""Relative tolerance of recomputed values, for another order of summation."""
ROUNDED = 1e-6
"""Relative tolerance of what is stored in float32 in one place and not in the other."""
SMALLEST, LARGEST = 1e-12, 1e6
"""Of measured lengths, angles and seconds, far beyond any vehicle."""
REACH = 100.0
"""Ends of the data in half widths of the middle 99.8 %."""
LABELS = (*SCENARIOS, "s1", "s2")
"""Parts of the test runs by name; the last two are halves, in order of generation."""

Trained: TypeAlias = Any
"""A `policy.TrainedModel`: what a certificate is about."""


class Proved:
    """An entry that the trusted core checks with its witness."""


class Follows(NamedTuple):
    """An entry that is derived again."""

    value: Any  # derived; a dictionary has exactly these keys
    share: float = REPEATED  # relative tolerance of numbers


class Measured(NamedTuple):
    """An entry that nothing binds within its range; the document is not signed."""

    low: Any = 0.0  # smallest value, or one a component
    high: Any = LARGEST  # largest value, or one a component
    kind: type = float  # int, float or str
    whole: int = 0  # n if the value is a share of n, else 0


Rule: TypeAlias = Proved | Follows | Measured | dict[str, Any] | list[Any]
"""Of an entry, or of all entries of an object or a list."""
SECONDS, TEXT, POSITIVE = Measured(), Measured(kind=str), Measured(SMALLEST)
COUNT = Measured(1, 10**9, int)
METRIC = {"metric": Proved(), "joint": Proved()}


def verify_document(document: Mapping[str, Any], trained: Trained) -> None:
    """Check a document from an untrusted source against a policy, without any search.

    Args:
        document: from `certify`.
        trained: the policy; its settings are those that the hash is about.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    # `is not True`: a text "false" or a number must not pass for a valid certificate.
    require(document.get("valid") is True, str(document.get("reason")))
    # Also the settings: the same weights under another controller are another policy.
    if document.get("policy_sha256") != trained.sha256:
        raise CertificateStale("the certificate is about other weights or settings")
    weights = exported(trained.model, trained.params)
    with well_formed(), np.errstate(all="ignore"):
        require_entry("", document, schema(document, trained, weights))
    # Types are what they should be from here on.
    proof = Certificate.from_document(document)
    verify(proof, trained.params, model=trained.model, weights=weights)
    with well_formed(), one_thread():
        require_lyapunov(document["lyapunov"], weights)
        for name, part in document["outputs"].items():
            require_output_metric(name, OutputMetric.from_document(part), weights)


def schema(
    document: Mapping[str, Any], trained: Trained, weights: Exported
) -> dict[str, Any]:
    """Return the rule of every entry that a document about this policy must have.

    A new entry is one line here; entries without a rule are refused.
    """
    lipschitz = document["lipschitz"]
    step = document["attacks"].get("step")
    low, high = map(trained.settings["environment"].get, ("low", "high"))
    outputs = [*readouts(weights), *decoders(weights)]
    networks = {"residual": weights.residual, **decoders(weights)}
    found = [f"{name}_slopes" for name, layers in networks.items() if layers]
    # All attacks, or those that need no running model.
    found += ["step_slopes", *(["step", "transport", *outputs] if step else [])]
    versions = ("python", "numpy", "jax", "sfkd_jax", "scipy")
    rules: dict[str, Any] = {
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
        "attacks": dict.fromkeys(found, Measured()),
        "attack": Follows(step),
        "tightness": Follows(document["alpha"] / step if step else None),
        "lyapunov": _lyapunov(document["lyapunov"], weights),
        # Of the settings; for logs without a box, that of the data.
        "env_box": Follows([[*low], [*high]], ROUNDED)
        if low is not None and high is not None
        else _box(trained, "env", 1.0),
        "boxes": _boxes(document, trained),
        "d_bar": _one_step(document["d_bar"], trained),
        "tube": _prediction(document),
        "outputs": {},
        "versions": dict.fromkeys(versions, TEXT),
        "seconds": SECONDS,
        "seconds_proof": SECONDS,
    }
    # With a metric of each output or without any: a corridor needs both.
    if document["outputs"] != {}:
        rules["outputs"] = {name: _output(document, name) for name in OUTPUTS}
        # Simulated runs have a corridor; logs have no plant to drive.
        if _is_simulated(trained):
            rules["corridor"] = _corridor(document, trained)
        if "recorded" in document:
            rules["recorded"] = _recorded(document)
    # What `certify` was asked for, if it was asked by a command.
    if "certification" in document:
        rules["certification"] = _asked_for(document)
    return rules


def _is_simulated(trained: Trained) -> bool:
    """Whether the data of the policy were simulated by this package."""
    return "segments" in trained.settings.get("dataset", {})


def _lyapunov(stated: Mapping[str, Any], weights: Exported) -> Rule:
    """The paper's constants, or the reason why there are none."""
    if not keeps_metrics(weights):
        return {"reason": Follows(ROTATES)}
    if "reason" in stated:
        return {"reason": TEXT}
    root = math.sqrt(stated["condition"])
    constants = dict.fromkeys(("rho", "condition", "alpha"), Proved())
    derived = dict.fromkeys(("c_1", "c_2"), Follows(root))
    return constants | derived | {"witness": METRIC}


def _box(trained: Trained, part: str, reach: float = REACH) -> list[Any]:
    """Corners of data with the scales of the model: at the half width or beyond it."""
    space = trained.settings["space"]
    centre, half = (np.asarray(space[f"{part}_{of}"]) for of in ("mean", "scale"))
    rounding = ROUNDED * (np.abs(centre) + half)
    # A channel that never moved has the scale 1, and may have no width.
    inner = np.where(half == 1.0, 0.0, half) - rounding
    outer = reach * half + rounding
    lower = (centre - outer, centre - inner)
    upper = (centre + inner, centre + outer)
    data = trained.settings.get("dataset", {})
    if part == "control" and trained.law is not None and _is_simulated(trained):
        # ν, κ and v_ref are drawn within limits.
        largest = np.append(trained.law.perturbation, data["peak_curvature"])
        slowest, fastest = data["speed"]
        lower = np.append(-largest, slowest) - rounding, lower[1]
        upper = upper[0], np.append(largest, fastest) + rounding
    return [Measured(*lower), Measured(*upper)]


def _boxes(document: Mapping[str, Any], trained: Trained) -> Rule:
    """Boxes of the data; those of logs have names."""
    rules: dict[str, Any] = {
        "state": _box(trained, "body"),
        "control": _box(trained, "control"),
        "env": Follows(document["env_box"], 0.0),
    }
    if columns := trained.settings.get("dataset", {}).get("columns"):
        # Columns of an environment that the policy ignores are not named.
        known = columns["environment"] if document["boxes"]["names"]["env"] else []
        named = [*columns["state"][3:]], [*columns["control"]], [*known]
        rules["names"] = Follows(dict(zip(rules, named, strict=True)))
    return rules


def _covered(stated: Mapping[str, Any], count: Rule, runs: Rule) -> dict[str, Any]:
    """A coverage with its counts, and the interval that follows from them."""
    share = stated["coverage"]
    sizes = stated["coverage_trajectories"]
    return {
        "coverage": Measured(0.0, 1.0, whole=sizes),
        "coverage_ci95": Follows(coverage_interval(share, stated["coverage_runs"])),
        "coverage_trajectories": count,
        "coverage_runs": runs,
    }


def _one_step(d_bar: Mapping[str, Any], trained: Trained) -> Rule:
    """Bounds on the error of one step, and on which runs they held."""
    count = d_bar["trajectories"]
    test = d_bar["coverage_trajectories"]
    runs = d_bar["runs"]
    level = d_bar["level"]
    rules = {
        "value": Follows(d_bar["one_step"]["latent"]),
        "level": Measured(SMALLEST, count / (count + 1)),
        "trajectories": COUNT,
        "runs": Measured(1, count, int),
        "holds_for": Follows(holds_for(runs, level)),
        **_covered(d_bar, COUNT, Measured(1, test, int)),
        "by_scenario": {},
        "one_step": dict.fromkeys(KINDS, Measured()),
        "validation": Measured(),
    }
    if not _is_simulated(trained):
        return rules
    # Every simulated segment is a run of its own, and all test runs have a label.
    data = trained.settings["dataset"]
    stated = d_bar["by_scenario"]
    *_, calibration, tested = sizes_of_parts(data["segments"], data["shares"])
    whole = Follows(tested)
    labels = [name for name in LABELS if name in stated]
    parts = [stated[name] for name in labels]
    sizes = [part["coverage_trajectories"] for part in parts]
    inside = sum(
        part["coverage"] * size for part, size in zip(parts, sizes, strict=True)
    )
    rules |= _covered(d_bar, whole, whole)
    rules |= dict.fromkeys(("trajectories", "runs"), Follows(calibration))
    rules["coverage"] = Follows(inside / tested)
    rules["by_scenario"] = {"s3": _covered(stated["s3"], whole, whole)}
    for name, part, size in zip(labels, parts, sizes, strict=True):
        rest = Follows(int(tested - (sum(sizes) - size)))
        rules["by_scenario"][name] = _covered(part, rest, rest)
    return rules


def _prediction(document: Mapping[str, Any]) -> Rule:
    """R_k, its limit, and the radii in metres and radians."""
    tube = document["tube"]
    lipschitz = document["lipschitz"]
    # With a decoder of increments the length of a step counts; it is measured.
    adds_up = "decoder" in lipschitz
    derived = tubes(
        alpha=document["alpha"],
        lipschitz=lipschitz,
        one_step=document["d_bar"]["one_step"],
        horizon=len(tube["latent"]),
        largest_increment=tube["largest_increment_m"] if adds_up else None,
    )
    rules: dict[str, Any] = {name: Follows(value) for name, value in derived.items()}
    return rules | ({"largest_increment_m": Measured()} if adds_up else {})


def _output(document: Mapping[str, Any], name: str) -> Rule:
    """The metric of an output, and its tubes with their coverage."""
    part = document["outputs"][name]
    runs = document["d_bar"]["coverage_trajectories"]
    intervals = {
        form: coverage_interval(part["coverage"][form], runs) for form in FORMS
    }
    # From the largest disturbance alone: on every run the larger of the two bounds.
    loosest = part["tube"]["asymptotic"] * (1 + REPEATED)
    tube = {"asymptotic": POSITIVE, "vehicle_to_nominal": Measured(SMALLEST, loosest)}
    return {
        **dict.fromkeys(("alpha", "lipschitz"), Proved()),
        "witness": METRIC,
        "tube": tube,
        "coverage": dict.fromkeys(FORMS, Measured(0.0, 1.0, whole=runs)),
        "coverage_ci95": Follows(intervals),
        "coverage_runs": Follows(runs),
    }


def _corridor(document: Mapping[str, Any], trained: Trained) -> Rule:
    """The corridor: its bounds, on which runs they held, and how it was attacked."""
    corridor = document["corridor"]
    d_bar = document["d_bar"]
    bounds = corridor["bounds"]
    attack = corridor["attack"]
    level = corridor["level"]
    runs = Follows(corridor["runs"])
    s3 = corridor["by_scenario"]["s3"]
    tube = bounds["vehicle_to_nominal_position"]
    # Car to nominal model plus nominal model to path: the triangle inequality.
    width = bounds["nominal"] + tube
    # Where all bounds held on all runs, nothing farther was seen.
    covered = corridor["coverage"] == 1.0
    kinds = (*JOINT, *ALONE)
    everywhere = len(DRIVES) * corridor["runs"]
    bounds_of: dict[str, Any] = {"bounds": dict.fromkeys(kinds, POSITIVE)}
    parts = [corridor["by_group"][name] for name in DRIVES]
    rules = [bounds_of | _covered(part, runs, runs) for part in parts]
    own = [part["bounds"] for part in parts]
    claim = _covered(corridor, runs, runs) | {
        # Each bound is that of its worst group.
        "bounds": Follows({n: max(each[n] for each in own) for n in kinds}, 0.0),
        "coverage": Follows(min(part["coverage"] for part in parts)),
        "by_group": dict(zip(DRIVES, rules, strict=True)),
    }
    return {
        "innovations": _innovations(corridor, trained, everywhere),
        "conditions": _conditions(document, trained),
        "level": Follows(d_bar["level"]),
        "runs": Measured(math.ceil(level / (1 - level) - ROUNDED), 10**6, int),
        "corridor_m": Follows(width),
        **claim,
        "by_scenario": {"s3": _covered(s3, *[Follows(everywhere)] * 2)},
        "seen": {
            "distance_m": Measured(0.0, tube if covered else LARGEST),
            "lateral_m": Measured(0.0, width if covered else LARGEST),
        },
        "attack": {
            "steps": COUNT,
            "lateral_m": Measured(),
            "distance_m": Measured(),
            "shielded_lateral_m": Measured(),
            "kept_lateral_m": Measured(0.0, attack["shielded_lateral_m"]),
            # With disturbances within their bound: leaving would refute the proof.
            "kept_distance_m": Measured(0.0, tube),
            "over_corridor": Follows(attack["kept_lateral_m"] / width),
            "over_tube": Follows(attack["kept_distance_m"] / tube),
        },
        # Of a simulator; they are in none of the bounds.
        **{name: COUNT for name in ("failed_runs",) if name in corridor},
        # No farther than the runs of the attack reach.
        "shield_horizon": Measured(1, LENGTH, int),
        "seconds": SECONDS,
    }


def _recorded(document: Mapping[str, Any]) -> Rule:
    """The corridor of recorded runs, at a level that so many can support."""
    bounds, about = map(document["recorded"].get, ("bounds", "conditions"))
    width = document["corridor"]["bounds"]["nominal"]
    count = about["runs"]
    measured = dict.fromkeys(("duration_s", "lateral_m"), POSITIVE)
    tube = bounds["vehicle_to_nominal_position"]
    return {
        "bounds": dict.fromkeys(JOINT, POSITIVE) | {"nominal": Measured(width)},
        "corridor_m": Follows(bounds["nominal"] + tube),
        "level": Measured(SMALLEST, count / (count + 1)),
        "conditions": {"runs": COUNT, "contents": TEXT} | measured,
    }


def _innovations(corridor: Mapping[str, Any], trained: Trained, runs: int) -> Rule:
    """The test of innovations: scales, thresholds and the alarms on new runs."""
    size = trained.law.gain.shape[-1] + 1
    levels = corridor["innovations"]["levels"]
    return {
        "levels": [Measured(low) for low in (0.0, *levels[:-1])],
        "deviation": [[POSITIVE] * size] * len(levels),
        # In standard deviations: a higher one would never be reached.
        "threshold": [[Measured(SMALLEST, 100.0)] * size] * len(WINDOWS),
        "calibration_runs": Follows(BATCHES * runs),
        "runs": Follows(runs),
        **dict.fromkeys(("alarms", "alarms_s3"), Measured(0, runs, int)),
    }


def _conditions(document: Mapping[str, Any], trained: Trained) -> Rule:
    """Where the corridor holds: conditions of the data, switching and sensors."""
    corridor = document["corridor"]
    settings = trained.settings
    bounds = corridor["bounds"]
    stated = corridor["conditions"]
    # On every run the nominal model started at a measurement: its error is in the tube.
    alphas = [document["outputs"][name]["alpha"] for name in OUTPUTS]
    position, yaw = (
        bounds[f"vehicle_to_nominal_{name}"] / alpha
        for name, alpha in zip(OUTPUTS, alphas, strict=True)
    )
    sensors = len(stated["sensor_noise"])
    largest = [position, position, yaw, *[REACH] * sensors][:sensors]
    data = settings["dataset"]
    given = drive_class(data) | {name: data[name] for name in EXCITATION}
    given["law_model"] = data["law"]["model"]
    dwell = stated["dwell_s"]
    dt = settings["vehicle"]["dt"]
    if contents := settings["vehicle"].get("contents"):
        given["identified_from"] = contents
    return {
        **{name: Follows(value) for name, value in given.items()},
        "env_box": Follows(document["env_box"], ROUNDED),
        "perturbation": Follows(np.asarray(trained.law.perturbation), ROUNDED),
        "dwell_s": [Measured(dt, dwell[1]), Measured(dt)],
        "duration_s": Measured(2.0),
        "sensor_noise": [Measured(0.0, high) for high in largest],
    }


def _asked_for(document: Mapping[str, Any]) -> Rule:
    """Settings of the command, which are settings of the corridor too."""
    steps = dict.fromkeys(("runs", "horizon", "attack_steps"), COUNT)
    seconds = {"duration": POSITIVE, "dwell": [POSITIVE, POSITIVE]}
    if made := document.get("corridor"):
        conditions = made["conditions"]
        sizes = (made["runs"], made["shield_horizon"])
        sizes += (made["attack"]["steps"],)
        steps = {name: Follows(n) for name, n in zip(steps, sizes, strict=True)}
        seconds = {name: Follows(conditions[f"{name}_s"]) for name in seconds}
    return {
        "level": Follows(document["d_bar"]["level"]),
        "horizon": Follows(len(document["tube"]["latent"])),
        "attack_starts": Measured(0, 10**6, int),
        "corridor": steps | seconds,
    }


def require_entry(where: str, stated: Any, rule: Rule) -> None:
    """Refuse the first entry that its rule does not allow, by name."""
    if isinstance(rule, dict):
        require(isinstance(stated, dict), f"{where or 'it'} is not an object")
        # Also keys without a rule: what nothing checks would be read by somebody.
        for key in dict.fromkeys([*rule, *stated]):
            name = f"{where}.{key}".removeprefix(".")
            require(key in stated, f"{name} is missing")
            require(key in rule, f"{name!a} is not an entry of a certificate")
            require_entry(name, stated[key], rule[key])
    elif isinstance(rule, list):
        fits = isinstance(stated, list) and len(stated) == len(rule)
        require(fits, f"{where} is not a list of {len(rule)}")
        for index, (entry, each) in enumerate(zip(stated, rule, strict=True)):
            require_entry(f"{where}.{index}", entry, each)
    elif isinstance(rule, Follows):
        follows = _equal(stated, rule.value, rule.share)
        require(follows, f"{where} does not follow from the policy and other entries")
    elif isinstance(rule, Measured):
        low = np.asarray(rule.low).tolist()
        high = np.asarray(rule.high).tolist()
        within = f"{rule.kind.__name__} from {low} to {high}"
        require(_in_range(stated, rule), f"{where} = {stated!a:.60} is no {within}")
    else:
        require(_is_finite(stated), f"{where} is not made of finite numbers")


def _is_finite(value: Any) -> bool:
    """Whether a value is a finite number, or lists of nothing else."""
    if isinstance(value, list):
        return all(map(_is_finite, value))
    # True is an int in Python, and "1" a number to numpy.
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value)


def _in_range(stated: Any, rule: Measured) -> bool:
    """Whether a measured entry is of its kind and between its limits."""
    if rule.kind is str:
        return isinstance(stated, str) and stated.isprintable() and len(stated) < 200
    whole = rule.kind is not int or type(stated) is int
    if not whole or not _is_finite(stated) or np.shape(stated) != np.shape(rule.low):
        return False
    of = rule.whole * stated if rule.whole else 0.0
    inside = np.all(
        (rule.low <= np.asarray(stated)) & (stated <= np.asarray(rule.high))
    )
    return bool(inside) and abs(of - round(of)) <= REPEATED * max(of, 1.0)


def _equal(stated: Any, derived: Any, share: float) -> bool:
    """Whether an entry is what is derived: numbers nearly, all else exactly."""
    if isinstance(derived, dict):
        # All keys: a value that is left out here would be checked nowhere.
        return (
            isinstance(stated, dict)
            and set(stated) == set(derived)
            and all(_equal(stated[key], derived[key], share) for key in derived)
        )
    expected = np.asarray(derived)
    if isinstance(derived, int) or expected.dtype.kind not in "if":
        return type(stated) is type(derived) and stated == derived
    # Both finite: any number is within a share of an infinite one.
    if not (_is_finite(stated) and _is_finite(expected.tolist())):
        return False
    actual = np.asarray(stated)
    # Relative to the derived value, which an attacker cannot choose.
    near = np.abs(actual - expected) <= share * np.abs(expected)
    return actual.shape == expected.shape and bool(np.all(near))
