"""The tables of the shield's benchmark: they hold its numbers, and what was missed is
named.
"""

import pytest

from benchmarks.quality import shield_table


def summary(departures=0, largest=0.0981, **shares):
    saved = {
        "copy_m": 0.0774,
        "distance_m": 0.0412,
        "inside": 1.0,
        "intervened": 0.0,
        "infeasible": 0.0,
    }
    return (
        {
            "drives": 200,
            "departures": departures,
            "largest_m": largest,
            "void": 0.0,
            "broken": 0.0,
        }
        | saved
        | shares
    )


def document(**changes):
    scripts = {
        "full lock": {
            "with": summary(intervened=0.98765),
            "without": summary(200, 84.0),
        },
        "NaN": {"with": summary(void=1e-5), "without": summary(200, None)},
    }
    planner = {
        "with": summary(intervened=0.0004) | {"rmse_m": 0.0093},
        "without": summary() | {"rmse_m": 0.0092},
    }
    step = {"with": {"median_ms": 4.5}, "without": {"median_ms": 4.0}, "added_ms": 0.5}
    car = {
        "bounds": {"nominal": 0.0781, "vehicle_to_nominal_position": 0.064},
        "scripts": scripts,
        "step": step,
    }
    return {
        "cars": {
            "dynamic": car
            | {"planner": planner | {"rmse_ratio": 0.0093 / 0.0092}}
            | changes
        }
    }


def test_the_tables_hold_every_planner_and_what_it_came_to():
    text = shield_table.table(document())
    assert "dynamic: W = 0.078 m, tube 0.064 m" in text
    assert (
        "| full lock | 200 of 200 → 0 of 200 | > 10 → 0.098 | 0.077 | 0.041 | 100 % | 98.77 % | 0 % | 0 % | 0 % |"
        in text
    )
    assert "| NaN | 200 of 200 → 0 of 200 | not finite → 0.098 |" in text
    assert "| 0.041 | 100 % | 0 % | 0 % | < 0.01 % | 0 % |" in text
    assert "| its own | 0 of 200 → 0 of 200 |" in text
    assert "| dynamic | 9.2 → 9.3 | 1.011 | 0.04 % | 4.00 → 4.50 | 0.50 |" in text
    for block in text.strip().split("\n\n"):
        rows = [line for line in block.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in rows}) <= 1


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({}, []),
        ({"step": {"added_ms": 1.2}}, ["dynamic: added_ms = 1.2, asked 1.0"]),
        ({"step": {"added_ms": float("nan")}}, ["dynamic: added_ms = nan, asked 1.0"]),
        ({"scripts": {"worst": {"with": summary(3)}}}, ["dynamic, worst: 3 departures"]),
        (
            {"planner": {"with": summary(1, intervened=0.01), "rmse_ratio": 1.03}},
            ["dynamic, its own: 1 departures", "dynamic: rmse_ratio = 1.03, asked 1.02"],
        ),
    ],
)  # fmt: skip
def test_what_was_asked_for_and_missed_is_named(changes, named):
    assert shield_table.misses(document(**changes)) == named
