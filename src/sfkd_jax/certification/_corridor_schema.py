"""The rule of every entry about a corridor in a certificate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._alarms import BATCHES
from sfkd_jax.certification._metric_claims import OUTPUTS
from sfkd_jax.certification._rules import LARGEST, Follows, Measured, Rule
from sfkd_jax.certification._schema import (
    COUNT,
    POSITIVE,
    REACH,
    ROUNDED,
    SECONDS,
    SMALLEST,
    TEXT,
    Trained,
    covered,
)
from sfkd_jax.certification._tubes import ALONE, JOINT
from sfkd_jax.certification._worst_runs import LENGTH
from sfkd_jax.certification.corridor import EXCITATION, drive_class
from sfkd_jax.control import WINDOWS
from sfkd_jax.scenarios import DRIVES


def corridor_rules(document: Mapping[str, Any], trained: Trained) -> Rule:
    """Return the rules of a corridor: its bounds, their coverage, and the attack.

    Args:
        document: the certificate.
        trained: the policy.
    """
    corridor = document["corridor"]
    bounds = corridor["bounds"]
    level = corridor["level"]
    s3 = corridor["by_scenario"]["s3"]
    tube = bounds["vehicle_to_nominal_position"]
    # The triangle inequality: from the car to the nominal model, and on to the path.
    width = bounds["nominal"] + tube
    # If all bounds held on all test runs, the car was seen no farther away.
    all_covered = corridor["coverage"] == 1.0
    runs_of_all_groups = len(DRIVES) * corridor["runs"]
    bounds_and_coverage = _bounds_and_coverage(corridor)
    return {
        "innovations": _innovations(corridor, trained, runs_of_all_groups),
        "conditions": _conditions(document, trained),
        "level": Follows(document["d_bar"]["level"]),
        "runs": Measured(math.ceil(level / (1 - level) - ROUNDED), 10**6, int),
        "corridor_m": Follows(width),
        **bounds_and_coverage,
        "by_scenario": {
            "s3": covered(s3, Follows(runs_of_all_groups), Follows(runs_of_all_groups))
        },
        "seen": {
            "distance_m": Measured(0.0, tube if all_covered else LARGEST),
            "lateral_m": Measured(0.0, width if all_covered else LARGEST),
        },
        "attack": _attack(corridor["attack"], tube, width),
        # Runs in which a simulator failed; they are in none of the bounds.
        **({"failed_runs": COUNT} if "failed_runs" in corridor else {}),
        # The shield looks no farther ahead than the runs of the attack reach.
        "shield_horizon": Measured(1, LENGTH, int),
        "seconds": SECONDS,
    }


def recorded_rules(document: Mapping[str, Any]) -> Rule:
    """Return the rules of the corridor of recorded runs."""
    recorded = document["recorded"]
    bounds = recorded["bounds"]
    count = recorded["conditions"]["runs"]
    simulated_width = document["corridor"]["bounds"]["nominal"]
    tube = bounds["vehicle_to_nominal_position"]
    return {
        "bounds": {
            **dict.fromkeys(JOINT, POSITIVE),
            "nominal": Measured(simulated_width),
        },
        "corridor_m": Follows(bounds["nominal"] + tube),
        # The highest level that so many runs can support.
        "level": Measured(SMALLEST, count / (count + 1)),
        "conditions": {
            "runs": COUNT,
            "contents": TEXT,
            "duration_s": POSITIVE,
            "lateral_m": POSITIVE,
        },
    }


def _bounds_and_coverage(corridor: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rules of the bounds and of their coverage, by group and in all."""
    names = (*JOINT, *ALONE)
    runs = Follows(corridor["runs"])
    groups = [corridor["by_group"][name] for name in DRIVES]
    rules_of_groups = [
        {"bounds": dict.fromkeys(names, POSITIVE), **covered(group, runs, runs)}
        for group in groups
    ]
    worst = {name: max(group["bounds"][name] for group in groups) for name in names}
    return {
        **covered(corridor, runs, runs),
        # Each bound is that of its worst group.
        "bounds": Follows(worst, 0.0),
        "coverage": Follows(min(group["coverage"] for group in groups)),
        "by_group": dict(zip(DRIVES, rules_of_groups, strict=True)),
    }


def _attack(attack: Mapping[str, Any], tube: float, width: float) -> Rule:
    """Return the rules of the attack on a corridor.

    Args:
        attack: the entries.
        tube: bound of the distance from the nominal model [m].
        width: of the corridor [m].
    """
    return {
        "steps": COUNT,
        "lateral_m": Measured(),
        "distance_m": Measured(),
        "shielded_lateral_m": Measured(),
        "kept_lateral_m": Measured(0.0, attack["shielded_lateral_m"]),
        # The disturbances of these runs are within their bound. To leave the tube would
        # refute the proof.
        "kept_distance_m": Measured(0.0, tube),
        "over_corridor": Follows(attack["kept_lateral_m"] / width),
        "over_tube": Follows(attack["kept_distance_m"] / tube),
    }


def _innovations(corridor: Mapping[str, Any], trained: Trained, runs: int) -> Rule:
    """Return the rules of the test of innovations.

    Args:
        corridor: the entries.
        trained: the policy.
        runs: number of test runs of all groups.
    """
    charts = trained.law.gain.shape[-1] + 1
    levels = corridor["innovations"]["levels"]
    return {
        # Rising.
        "levels": [Measured(low) for low in (0.0, *levels[:-1])],
        "deviation": [[POSITIVE] * charts] * len(levels),
        # In standard deviations: a higher threshold would never be reached.
        "threshold": [[Measured(SMALLEST, 100.0)] * charts] * len(WINDOWS),
        "calibration_runs": Follows(BATCHES * runs),
        "runs": Follows(runs),
        "alarms": Measured(0, runs, int),
        "alarms_s3": Measured(0, runs, int),
    }


def _conditions(document: Mapping[str, Any], trained: Trained) -> Rule:
    """Return the rules of the conditions: of the data, of switches and of sensors."""
    settings = trained.settings
    stated = document["corridor"]["conditions"]
    position, yaw = _largest_starts(document)
    sensors = len(stated["sensor_noise"])
    largest_noise = [position, position, yaw, *[REACH] * sensors][:sensors]
    data = settings["dataset"]
    expected = {
        **drive_class(data),
        **{name: data[name] for name in EXCITATION},
        "law_model": data["law"]["model"],
    }
    contents = settings["vehicle"].get("contents")
    if contents:
        expected["identified_from"] = contents
    dwell = stated["dwell_s"]
    dt = settings["vehicle"]["dt"]
    return {
        **{name: Follows(value) for name, value in expected.items()},
        "env_box": Follows(document["env_box"], ROUNDED),
        "perturbation": Follows(np.asarray(trained.law.perturbation), ROUNDED),
        "dwell_s": [Measured(dt, dwell[1]), Measured(dt)],
        "duration_s": Measured(2.0),
        "sensor_noise": [Measured(0.0, high) for high in largest_noise],
    }


def _largest_starts(document: Mapping[str, Any]) -> list[float]:
    """Return how large the noise of position [m] and yaw [rad] can be at most.

    On every run the nominal model started at a measurement, and the tube contains the
    error of that start.
    """
    bounds = document["corridor"]["bounds"]
    return [
        bounds[f"vehicle_to_nominal_{name}"] / document["outputs"][name]["alpha"]
        for name in OUTPUTS
    ]
