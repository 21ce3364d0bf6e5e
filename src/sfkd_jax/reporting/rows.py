"""Rows of results.json: their names, and which of them may be compared."""

from __future__ import annotations

from typing import Any

from sfkd_jax.evaluation import identity
from sfkd_jax.evaluation.formats import dig, is_number, short
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.reporting.style import family, file_stem, label, ordered, scenario_label

NO_MODEL = ("nominal", "oracle", "law")
"""Systems without a learned model; their names imply whether they observe e."""
SAMPLINGS = {
    "feedback": "sampling around a feedback law",
    "plain": "plain sampling",
    "law": "path coordinates, sampling around their law",
}


def name_of(row: Row) -> str:
    """Name a row by its system and, where it is not obvious, by its access to e."""
    system, env = family(str(row.get("system"))), str(row.get("env"))
    shown = label(system)
    if env == "estimated":
        return f"{shown} (e estimated)"
    in_name = env == "measured" and shown.endswith(" e")  # as in "reads e"
    if in_name or system in NO_MODEL or system.startswith("sfkd"):
        return shown
    return shown + {"measured": " (e)", "none": " (no e)"}.get(env, "")


def search_words(row: Row) -> str:
    """Describe the sampling of a row, with its controller and planner if unusual."""
    sampling, controller = row.get("sampling"), row.get("controller")
    words = [SAMPLINGS.get(str(sampling), str(sampling))] if sampling else []
    words += [f"controller {controller}"] if controller not in (None, "mppi") else []
    planner = identity(row)["planner"]
    usual = identity({"controller": controller})["planner"]
    words += [f"planner {planner}"] if planner != usual else []
    return ", ".join(words)


def vehicle_stem(row: Row) -> str:
    """The vehicle and its inner loop as part of a file name."""
    vehicle, inner_loop = str(row.get("vehicle")), str(row.get("inner_loop"))
    words = vehicle if inner_loop in ("none", "None") else f"{vehicle}_{inner_loop}"
    return file_stem(words)


def groups_of(rows: list[Row]) -> list[list[Row]]:
    """Rows that may be compared: of one scenario, vehicle, sampling and controller.

    A row whose controller draws no samples is in every group of its scenario and
    vehicle.
    """

    def where(row: Row) -> tuple[str, ...]:
        return tuple(str(row.get(k)) for k in ("scenario", "vehicle", "inner_loop"))

    def search(row: Row) -> tuple[str, str] | None:
        sampling = row.get("sampling")
        return (str(sampling), search_words(row)) if sampling else None

    groups = []
    for key in sorted(set(map(where, rows))):
        here = [row for row in rows if where(row) == key]
        for kind in sorted(filter(None, set(map(search, here)))) or [None]:
            group = [row for row in here if search(row) in (kind, None)]
            order = ordered({str(row.get("system")) for row in group})
            group.sort(key=lambda row, order=order: order.index(str(row.get("system"))))
            groups.append(group)
    return groups


def group_title(group: list[Row]) -> str:
    """What the rows of a group have in common."""
    row = group[0]
    search = search_words(next((one for one in group if one.get("sampling")), {}))
    parts = [f"Scenario {scenario_label(str(row.get('scenario')))}"]
    loop = " under a speed loop" if row.get("inner_loop") == "speed" else ""
    parts += [f"{row['vehicle']} vehicle{loop}"] if row.get("vehicle") else []
    parts += [search] if search else []
    if is_number(row.get("episodes")):
        seconds = row.get("episode_s")
        length = f" of {short(seconds)} s" if is_number(seconds) else ""
        parts.append(f"{short(row['episodes'])} episodes{length}")
    return ", ".join(parts)


def row_of(group: list[Row], system: str) -> Row:
    """The row of a system, preferably the one that measures e; empty if none."""
    rows = [row for row in group if row.get("system") == system]
    measured = (row for row in rows if row.get("env") == "measured")
    return next(measured, rows[0] if rows else {})


def headline(groups: list[list[Row]], settings: dict[str, Any]) -> list[Row]:
    """The group that the summary is about; empty if there is none.

    It is of the run's own scenario or else of the last one, and preferably samples
    around feedback with the run's own controller.
    """

    def score(group: list[Row]) -> tuple[Any, ...]:
        scenario = str(group[0].get("scenario"))
        own = str(settings.get("experiment")).startswith(scenario)
        feedback = any(row.get("sampling") == "feedback" for row in group)
        same = any(_own_controller(row, settings) for row in group)
        return own, scenario, feedback, same

    return max(groups, key=score, default=[])


def _own_controller(row: Row, settings: dict[str, Any]) -> bool:
    """Whether a row used the controller that the run was made with."""
    own = settings.get("controller") or {}
    planner = {"planner": own["planner"]} if "planner" in own else {}
    usual = identity({"controller": own.get("name")} | planner)
    return all(identity(row)[key] == usual[key] for key in ("controller", "planner"))


def model_of(settings: dict[str, Any]) -> str:
    """Name of the system that a run trained, as in results.json."""
    model = settings.get("model")
    return str(dig(model, "system") or dig(model, "name") or "sfkd")
