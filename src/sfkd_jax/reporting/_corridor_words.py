"""The corridor of a certificate in words and numbers: what is promised, for what, what is proved and what measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax.reporting._blocks import Block, Heading, Table, Text, picture
from sfkd_jax.reporting._corridor import Corridor, around_drives
from sfkd_jax.reporting._numbers import (
    DASH,
    dig,
    interval,
    is_number,
    number,
    short,
    upper,
)
from sfkd_jax.reporting._scene import scenes_of
from sfkd_jax.reporting._words import holds, model_of


def corridor(
    run: Path, record: dict[str, Any] | None, settings: dict[str, Any], place: Path
) -> list[Block]:
    """The section of a certificate that holds and has a corridor; nothing for another."""
    found = dig(record, "corridor")
    width, tube = (
        dig(found, "bounds", name) for name in ("nominal", "followed_position")
    )
    if record is None or not holds(record) or not is_number(dig(found, "corridor_m")):
        return []
    blocks: list[Block] = [
        Heading(2, "How far the car strays"),
        *corridor_words(record),
        corridor_table(found),
    ]
    system = model_of(settings)
    scenes = [scene for scene in scenes_of(run) if system in scene.lateral]
    if scenes and is_number(width) and is_number(tube):
        half = Corridor(float(width), float(tube))
        blocks.append(
            picture(place, "corridor", _CAPTION, around_drives, scenes[0], system, half)
        )
    return blocks


_CAPTION = (
    "Signed lateral deviation of every episode in the certified corridor, left positive. Dark: where the shield keeps "
    "the nominal copy of the car. Light: how far the car may be from that copy."
)


def corridor_words(record: dict[str, Any]) -> list[Text]:
    """What is promised and as long as what, what of it is proved, what is measured, and what an attack reached."""
    found = record["corridor"]
    level, bounds = _share(found.get("level")), found.get("bounds")
    promised = (
        f"With this certificate the car stays within {upper(found['corridor_m'])} m of its path as long as "
        f"{_class(found.get('class'))}. At least {level} of such drives keep it. Whatever a planner asks for, the "
        f"shield lets no more of it through than keeps a nominal copy of the car within W = "
        f"{upper(dig(bounds, 'nominal'))} m of the path; and the car stays within "
        f"{upper(dig(bounds, 'followed_position'))} m of that copy while the disturbances are those of such drives. A "
        "step at which the shield cannot keep W, or at which the car is farther from its copy than that, is reported "
        "while driving."
    )
    alpha = upper(dig(record, "outputs", "position", "alpha"))
    proved = (
        f"In a metric for the lateral deviation, a step of the model brings two states to at most {alpha} times their "
        "distance, for every perturbation, road, speed and environment in the box, and for any switching. So how far "
        "the car is from its copy follows from the one-step disturbances of a drive and from nothing else."
    )
    return [
        Text(promised, "The corridor."),
        Text(proved, "Proved."),
        Text(_measured(found), "Measured, not proved."),
        *(
            [Text(_at_rest(found["fixed_points"]), "Without a copy.")]
            if dig(found, "fixed_points", "corridor_m")
            else []
        ),
        *(
            [Text(_attacked(found), "Attacked.")]
            if isinstance(found.get("attack"), dict)
            else []
        ),
    ]


def _class(about: Any) -> str:
    """What a drive must be like."""
    low, high = (_entries(dig(about, "env_box"), side, 2) for side in (0, 1))
    speed, dwell = (_entries(about, name, 2) for name in ("speed", "dwell_s"))
    steering, drive = _entries(about, "perturbation", 2)
    spread, push = (
        _entries(about, name, 2) for name in ("steering_excitation", "speed_excitation")
    )
    return (
        f"it drives at {short(speed[0])} to {short(speed[1])} m/s on a road of a curvature of at most "
        f"{short(dig(about, 'peak_curvature'))} 1/m and a lateral acceleration of at most "
        f"{short(dig(about, 'lateral_acceleration'))} m/s²; friction lies in {short(low[0])} to {short(high[0])}, side "
        f"wind in {short(low[1])} to {short(high[1])} m/s, and they hold for at least {short(dwell[0])} s between two "
        f"switches; what the shield lets through adds at most {short(steering)} rad of steering and {short(drive)} "
        f"m/s² of drive to the law, with a spread of {short(spread[0])} to {short(spread[1])} rad and "
        f"{short(push[0])} to {short(push[1])} m/s²; and the drive lasts at most {short(dig(about, 'duration_s'))} s"
    )


def _entries(record: Any, key: str | int, count: int) -> list[Any]:
    """That many entries of a list in a record, or of one in a list; None for each where there are not."""
    values = dig(record, key) if isinstance(key, str) else None
    if isinstance(key, int) and isinstance(record, list) and len(record) > key:
        values = record[key]
    return (
        values if isinstance(values, list) and len(values) == count else [None] * count
    )


def _measured(found: dict[str, Any]) -> str:
    drives, s3 = short(found.get("drives")), dig(found, "by_scenario", "s3")
    text = (
        f"How large those disturbances are, and W. Of the drives on the true vehicle {drives} fix units, {drives} "
        f"calibrate and {drives} test: on {_share(found.get('coverage'))} of the last all bounds hold (95 % interval "
        f"of that fraction {interval(found.get('coverage_ci95'))})"
    )
    if is_number(dig(s3, "coverage")):
        text += f", and on {_share(dig(s3, 'coverage'))} of {short(dig(s3, 'coverage_drives'))} drives of S3, "
        text += (
            f"whose schedule no calibration saw ({interval(dig(s3, 'coverage_ci95'))})"
        )
    lateral, distance = (
        dig(found, "seen", name) for name in ("lateral_m", "distance_m")
    )
    if is_number(lateral) and is_number(distance):
        text += f". The test drives came to {number(lateral)} m from the path and {number(distance)} m from their copy"
    return text + "."


def _at_rest(part: dict[str, Any]) -> str:
    between, after = (
        [upper(dig(part, name, who)) for who in ("law", "planner")]
        for name in ("corridor_m", "after_switch_m")
    )
    return (
        "On every road the model alone would come to rest at one point, and the car follows it at a distance that the "
        f"rate bounds: it stays within {between[0]} m of its path under the law alone and within {between[1]} m "
        f"whatever a planner asks for within the limits, {after[0]} and {after[1]} m right after a switch, once the "
        "start is forgotten, with no shield and no copy, while the disturbances are those of such drives. How far "
        f"those points move is measured on {short(part.get('points'), 6)} of them, not proved."
    )


def _attacked(found: dict[str, Any]) -> str:
    attack = found["attack"]
    text = (
        f"A search over {short(attack.get('steps'))} steps of the true vehicle, for perturbations, roads, winds and "
        f"switches that do harm together, brought the car to {number(attack.get('lateral_m'))} m from its path, and to "
        f"{number(attack.get('shielded_lateral_m'))} m with the shield. Such drives are not promised to keep the "
        "bounds on the disturbances"
    )
    if is_number(attack.get("over_corridor")) and is_number(
        attack.get("kept_lateral_m")
    ):
        text += (
            f"; where they did keep them, the car came to {number(attack['kept_lateral_m'])} m, "
            f"{number(attack['over_corridor'], 2)} times the corridor"
        )
    return text + "."


def corridor_table(found: dict[str, Any]) -> Table:
    """Every bound, with what it is and whether it holds together with the others."""
    together, alone = "with the others", "by itself"
    named = (
        ("corridor_m", "Corridor: car from its path, W + tube [m]", together),
        ("nominal", "W: nominal copy from the path [m]", together),
        ("followed_position", "Tube: car from its copy, across [m]", together),
        ("followed_yaw", "Tube: car from its copy, heading [rad]", together),
        (
            "for_ever_position",
            "The same from the largest disturbance alone, across [m]",
            alone,
        ),
        (
            "for_ever_yaw",
            "The same from the largest disturbance alone, heading [rad]",
            alone,
        ),
    )
    bounds = found.get("bounds")
    values = found | (bounds if isinstance(bounds, dict) else {})
    level = _share(found.get("level"))
    rows = [
        [name, upper(values.get(key)), f"{level}, {kind}"] for key, name, kind in named
    ]
    return Table(
        ["Bound", "At most", "Holds on a share of drives of"], rows, prose=True
    )


def _share(value: Any) -> str:
    return f"{short(100 * value, 4)} %" if is_number(value) else DASH
