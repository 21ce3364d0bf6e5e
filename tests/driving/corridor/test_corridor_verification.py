"""A forged corridor in the document of a certificate."""

import pytest
from documents import document, hashed, refusal
from helpers import put


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("corridor.corridor_m", 1e-6, "corridor_m does not follow"),
        ("corridor.bounds.nominal", 1e-6, "corridor_m does not follow"),
        ("corridor.innovations.threshold", [], "of another size"),
        ("corridor.innovations.levels", [], "of another size"),
        ("corridor.conditions.env_box", [[0.0], [1.0]], "of another size"),
        ("corridor.bounds.nominal", -0.1, "nominal = -0.1 is not in [0, inf)"),
        ("corridor.conditions.dwell_s", [6.0, 3.0], "dwell_s is not in ascending"),
        ("corridor.recorded", [], "corridor.recorded is not an object"),
        ("corridor.late_controls.0.later_s", 0.25, "late corridors do not rise"),
        ("corridor.late_sensors.1.later_s", float("nan"), "late_sensors"),
        ("corridor.late_sensors.0.later_s", 0.0, "later_s = 0.0 is not in"),
        ("corridor.late_sensors.2.bounds.nominal", -1.0, "nominal = -1.0 is not in"),
        ("corridor.late_controls", {}, "corridor.late_controls"),
    ],
)
def test_a_corridor_that_does_not_follow_or_would_break_a_reader_is_refused(
    path, value, reason
):
    changed = hashed(put(document("dynamic_path"), path, value))
    assert reason in refusal(changed, "dynamic_path")


def test_a_corridor_needs_a_law_and_metrics():
    changed = document("kinematic") | {"corridor": document("dynamic_path")["corridor"]}
    assert "a corridor needs a law" in refusal(hashed(changed), "kinematic")
