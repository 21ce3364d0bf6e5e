"""Many runs as records: settings, certificate, prediction and driving of each."""

from __future__ import annotations

import glob
from collections import Counter
from pathlib import Path
from typing import Any, TypeAlias

from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.reporting.rows import groups_of, model_of, row_of
from sfkd_jax.reporting.run import holds, read_certificate, read_optional, read_policy
from sfkd_jax.store import as_artefact_error

Record: TypeAlias = dict[str, Any]


def records_of(root: Path, pattern: str) -> list[Record]:
    """One record per run, ordered by system, vehicle, inner loop, ρ + β, β and path.

    Args:
        root: at which the pattern starts.
        pattern: of run directories; those without settings.json are skipped.

    Raises:
        ValueError: no run matches, or a file of a run is not JSON.
    """
    names = [
        name
        for name in sorted(glob.glob(pattern, root_dir=root))
        if (root / name / "settings.json").exists()
    ]
    if not names:
        raise ValueError(f"no run under {root} matches {pattern!r}")
    records = sorted((_record(root / name, name) for name in names), key=_order)
    for record in records:
        similar = [other for other in records if _same_sum(other, record)]
        record["smallest_of_its_betas"] = record is _best(similar)
    return records


def _order(record: Record) -> tuple[Any, ...]:
    """Sort key; null comes last."""
    sides = _sum(record), record["beta"]
    known = (x if is_number(x) else float("inf") for x in sides)
    return (*_setting(record), *known, record["run"])


def curves(records: list[Record]) -> list[list[Record]]:
    """The certified runs at the most common β by α, for each vehicle and inner loop."""
    certified = [record for record in records if is_number(record["alpha"])]
    betas = Counter(sorted(r["beta"] for r in certified if is_number(r["beta"])))
    usual = (betas.most_common(1) or [(None, 0)])[0][0]
    main = [record for record in certified if record["beta"] == usual]
    settings = dict.fromkeys(map(_setting, main))
    lines = [[r for r in main if _setting(r) == one] for one in settings]
    return [sorted(line, key=lambda record: record["alpha"]) for line in lines]


def scenario_of(records: list[Record]) -> str | None:
    """The scenario of most runs; of several, the last by name."""
    names = [name for record in records for name in record["closed_loop"]]
    names = Counter(sorted(names, reverse=True))
    return names.most_common(1)[0][0] if names else None


def steps_of(records: list[Record], key: str) -> str:
    """The horizon of `key` (open_loop or tube) if all runs agree, else "T"."""
    steps = {record[key]["steps"] for record in records if record[key]["steps"]}
    return str(steps.pop()) if len(steps) == 1 else "T"


def _record(run: Path, name: str) -> Record:
    settings = read_optional(run / "settings.json") or {}
    errors = read_optional(run / "open_loop.json")
    certificate = read_certificate(run, read_policy(run) or {})
    rows = (read_optional(run / "results.json") or {}).get("rows") or []
    with as_artefact_error(run / "settings.json", ValueError):
        model, system = settings.get("model"), model_of(settings)
        record = {
            "run": name,
            "system": system,
            "vehicle": dig(settings, "vehicle", "name"),
            "inner_loop": dig(settings, "vehicle", "inner_loop"),
            "rho": dig(model, "rho"),
            "beta": dig(model, "beta"),
            "seed": settings.get("seed"),
        }
    with as_artefact_error(run / "certificate.json", ValueError):
        record |= _certified(certificate)
    with as_artefact_error(run / "open_loop.json", ValueError):
        record["open_loop"] = _predicting(errors)
    with as_artefact_error(run / "results.json", ValueError):
        record["closed_loop"] = _driving(rows, system)
    return record


def _certified(certificate: dict[str, Any] | None) -> Record:
    """The bounds of a certificate, or nulls and the reason for them."""
    reason = None
    if certificate is None:
        reason = "certificate.json is missing"
    elif not holds(certificate):
        reason = certificate.get("reason") or "the file gives no reason"
    proof = {} if reason or certificate is None else certificate
    alpha, separate = proof.get("alpha"), proof.get("alpha_separate")
    bound, tube = dig(proof, "d_bar") or {}, dig(proof, "tube") or {}
    radii = tube.get("latent") or []
    drives = bound.get("by_scenario") or {}
    on_validation = _ultimate(bound.get("validation"), alpha)
    return {
        "reason": reason,
        "alpha": alpha,
        "alpha_separate": separate,
        "alpha_joint": proof.get("alpha_joint"),
        "attack": proof.get("attack"),
        "tightness": proof.get("tightness"),
        "d_bar": bound.get("value"),
        "d_bar_validation": bound.get("validation"),
        "tube": {
            "steps": len(radii),
            "latent": dig(radii, "-1"),
            "position_m": dig(tube, "physical", "position_m", "-1"),
        },
        "ultimate": tube.get("ultimate"),
        "ultimate_separate": _ultimate(bound.get("value"), separate),
        "ultimate_validation": on_validation,
        "ultimate_body_validation": _product(
            dig(proof, "lipschitz", "body"), on_validation
        ),
        "coverage": {
            name: dig(drive, "coverage") for name, drive in sorted(drives.items())
        },
    }


def _ultimate(d_bar: Any, alpha: Any) -> float | None:
    """d̄ / (1 − α), or None for α of one or more."""
    known = is_number(d_bar) and is_number(alpha)
    return d_bar / (1 - alpha) if known and alpha < 1 else None


def _product(left: Any, right: Any) -> float | None:
    return left * right if is_number(left) and is_number(right) else None


def _predicting(errors: dict[str, Any] | None) -> Record:
    """Errors at the last step ahead."""
    keys = ("position_rmse_m", "longitudinal_rmse_m", "lateral_rmse_m")
    return {key: dig(errors, key, "-1") for key in ("steps", *keys)}


def _driving(rows: list[dict[str, Any]], system: str) -> dict[str, Record]:
    """The row of the system by scenario; of several, that of feedback sampling."""
    driven: dict[str, Record] = {}
    for group in groups_of(rows):
        own = row_of(group, system)
        if own:
            driven.setdefault(str(own.get("scenario")), _driven(own))
    return driven


def _driven(row: dict[str, Any]) -> Record:
    claim = dig(row, "violation") or {}
    certified = claim if claim.get("v1_tube") == "certified" else {}
    conformal = ("v1_conformal", "v1_conformal_radius_m")
    return {
        "rmse_m": row.get("rmse_m"),
        "ratio_to_oracle": row.get("ratio_to_oracle"),
        "smoothness_rad_per_s": row.get("smoothness_rad_per_s"),
        "v0": claim.get("v0"),
        "v1_certified": certified.get("v1"),
        "v1_certified_radius_m": certified.get("v1_radius_m"),
    } | {key: claim.get(key) for key in conformal}


def _best(records: list[Record]) -> Record | None:
    """The record with the smallest ultimate bound on validation drives.

    The bound is that of the body state, because the unit of the latent differs from run
    to run. None if all have the same β.
    """
    key = "ultimate_body_validation"
    known = [record for record in records if is_number(record[key])]
    several = len({record["beta"] for record in known}) > 1
    return min(known, key=lambda record: record[key]) if several else None


def _same_sum(one: Record, other: Record) -> bool:
    """Whether two runs have the same vehicle, inner loop and ρ + β."""
    return (_setting(one), _sum(one)) == (_setting(other), _sum(other))


def _setting(record: Record) -> tuple[str, ...]:
    return tuple(str(record[key]) for key in ("system", "vehicle", "inner_loop"))


def _sum(record: Record) -> float | None:
    """ρ + β of the settings, without rounding errors."""
    sides = record["rho"], record["beta"]
    return round(sum(sides), 9) if all(map(is_number, sides)) else None
