"""Many runs as records: what each was asked for, what is certified about it, how it predicts and how it drives."""

from __future__ import annotations

import glob
from collections import Counter
from pathlib import Path
from typing import Any, TypeAlias

from sfkd_jax.artefacts import as_artefact_error
from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.reporting.rows import groups_of, model_of, row_of
from sfkd_jax.reporting.run import holds, read_certificate, read_optional

Record: TypeAlias = dict[str, Any]


def records_of(root: Path, pattern: str) -> list[Record]:
    """One record per run, ordered by system, vehicle, inner loop, ρ + β, β and place.

    Args:
        root: that the pattern starts from.
        pattern: of run directories; those without settings.json are no runs.

    Raises:
        ValueError: no run matches, or a file of a run is not JSON.
    """
    places = [
        place
        for place in sorted(glob.glob(pattern, root_dir=root))
        if (root / place / "settings.json").exists()
    ]
    if not places:
        raise ValueError(f"no run under {root} matches {pattern!r}")
    records = [_record(root / place, place) for place in places]
    records.sort(
        key=lambda record: (
            *_convention(record),
            *map(_last, (_asked(record), record["beta"])),
            record["run"],
        )
    )
    for record in records:
        record["smallest_of_its_betas"] = record is _best(
            [r for r in records if _rivals(r, record)]
        )
    return records


def curves(records: list[Record]) -> list[list[Record]]:
    """The certified runs at the most common β: one list per system, vehicle and inner loop, by rising α."""
    certified = [record for record in records if is_number(record["alpha"])]
    betas = Counter(
        sorted(record["beta"] for record in certified if is_number(record["beta"]))
    )
    main = [
        record
        for record in certified
        if record["beta"] == (betas.most_common(1) or [(None, 0)])[0][0]
    ]
    lines = [
        [record for record in main if _convention(record) == one]
        for one in dict.fromkeys(map(_convention, main))
    ]
    return [sorted(line, key=lambda record: record["alpha"]) for line in lines]


def scenario_of(records: list[Record]) -> str | None:
    """The scenario that most runs were driven on; of several, the last by name."""
    names = Counter(
        sorted(
            (name for record in records for name in record["closed_loop"]), reverse=True
        )
    )
    return names.most_common(1)[0][0] if names else None


def steps_of(records: list[Record], key: str) -> str:
    """How many steps `key` (open_loop or tube) reaches, if all runs agree, else "T"."""
    found = {record[key]["steps"] for record in records if record[key]["steps"]}
    return str(found.pop()) if len(found) == 1 else "T"


def _record(run: Path, place: str) -> Record:
    settings, errors = (
        read_optional(run / "settings.json") or {},
        read_optional(run / "open_loop.json"),
    )
    certificate = read_certificate(run, read_optional(run / "policy.json") or {})
    rows = (read_optional(run / "results.json") or {}).get("rows") or []
    with as_artefact_error(run / "settings.json", ValueError):
        model, system = settings.get("model"), model_of(settings)
        asked = {
            "rho": dig(model, "rho"),
            "beta": dig(model, "beta"),
            "seed": settings.get("seed"),
        }
        vehicle = {
            "vehicle": dig(settings, "vehicle", "name"),
            "inner_loop": dig(settings, "vehicle", "inner_loop"),
        }
    with as_artefact_error(run / "certificate.json", ValueError):
        certified = _certified(certificate)
    with as_artefact_error(run / "open_loop.json", ValueError):
        predicting = _predicting(errors)
    with as_artefact_error(run / "results.json", ValueError):
        driving = _driving(rows, system)
    found = {"run": place, "system": system, **vehicle, **asked, **certified}
    return found | {"open_loop": predicting, "closed_loop": driving}


def _certified(certificate: dict[str, Any] | None) -> Record:
    """What a certificate says, or nulls and the reason why it says nothing."""
    reason = None
    if certificate is None:
        reason = "certificate.json is missing"
    elif not holds(certificate):
        reason = certificate.get("reason") or "the file gives no reason"
    proof = {} if reason or certificate is None else certificate
    alpha, separate = proof.get("alpha"), proof.get("alpha_separate")
    bound, tube = dig(proof, "d_bar") or {}, dig(proof, "tube") or {}
    radii, position = (
        tube.get("latent") or [],
        dig(tube, "physical", "position_m") or [],
    )
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
            "latent": _end(radii),
            "position_m": _end(position),
        },
        "ultimate": tube.get("ultimate"),
        "ultimate_separate": _ultimate(bound.get("value"), separate),
        "ultimate_validation": on_validation,
        "ultimate_body_validation": _times(
            dig(proof, "lipschitz", "body"), on_validation
        ),
        "coverage": {
            name: dig(drive, "coverage") for name, drive in sorted(drives.items())
        },
    }


def _ultimate(d_bar: Any, alpha: Any) -> float | None:
    """d̄ / (1 − α), which no α of one or more has."""
    return (
        d_bar / (1 - alpha)
        if is_number(d_bar) and is_number(alpha) and alpha < 1
        else None
    )


def _times(left: Any, right: Any) -> float | None:
    return left * right if is_number(left) and is_number(right) else None


def _predicting(errors: dict[str, Any] | None) -> Record:
    """Errors at the last step ahead."""
    keys = ("position_rmse_m", "longitudinal_rmse_m", "lateral_rmse_m")
    return {"steps": _end(dig(errors, "steps") or [])} | {
        key: _end(dig(errors, key) or []) for key in keys
    }


def _driving(rows: list[dict[str, Any]], system: str) -> dict[str, Record]:
    """The system's own row of each scenario; the one with feedback sampling where there are several."""
    found: dict[str, Record] = {}
    for block in groups_of(rows):
        own = row_of(block, system)
        if own:
            found.setdefault(str(own.get("scenario")), _driven(own))
    return found


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
    """The smallest ultimate bound on validation drives, where there are several β to choose from.

    In units of the body state: the latent's own unit differs from run to run.
    """
    known = [
        record for record in records if is_number(record["ultimate_body_validation"])
    ]
    several = len({record["beta"] for record in known}) > 1
    return (
        min(known, key=lambda record: record["ultimate_body_validation"])
        if several
        else None
    )


def _rivals(one: Record, other: Record) -> bool:
    """Whether two runs differ in how they share ρ + β out, not in its sum."""
    return (_convention(one), _asked(one)) == (_convention(other), _asked(other))


def _convention(record: Record) -> tuple[str, ...]:
    return tuple(str(record[key]) for key in ("system", "vehicle", "inner_loop"))


def _asked(record: Record) -> float | None:
    """ρ + β as asked for, less the rounding of the sum."""
    sides = record["rho"], record["beta"]
    return round(sum(sides), 9) if all(map(is_number, sides)) else None


def _last(value: Any) -> float:
    """A key to sort by, null last."""
    return value if is_number(value) else float("inf")


def _end(values: list[Any]) -> Any:
    return values[-1] if values else None
