"""The corridor in a report: its numbers are those of the certificate, and nothing that
is missing is claimed.
"""

import pytest
from test_report import documents, nulled, report_of, text_of, write_run

HEADING = "How far the car strays"


def certificate(**changes):
    corridor = {
        "class": {
            "speed": [8.0, 10.5], "peak_curvature": 0.02, "lateral_acceleration": 2.0, "duration_s": 60.0,
            "env_box": [[0.3, -8.0], [0.9, 8.0]], "dwell_s": [3.0, 6.0], "perturbation": [0.03, 1.0],
            "steering_excitation": [0.002, 0.025], "speed_excitation": [0.05, 0.6],
        },
        "level": 0.95, "drives": 150, "corridor_m": 0.21311,
        "bounds": {
            "nominal": 0.11111, "followed_position": 0.10201, "followed_yaw": 0.04211, "for_ever_position": 0.1533,
            "for_ever_yaw": 0.0802,
        },
        "coverage": 0.9733, "coverage_ci95": [0.9331, 0.9926], "coverage_drives": 150,
        "by_scenario": {"s3": {"coverage": 0.96, "coverage_ci95": [0.915, 0.985], "coverage_drives": 140}},
        "seen": {"distance_m": 0.0502, "lateral_m": 0.0931},
        "fixed_points": {
            "points": 67500, "corridor_m": {"law": 0.25111, "planner": 0.42611},
            "after_switch_m": {"law": 0.27111, "planner": 0.44611},
        },
        "attack": {
            "steps": 200000, "lateral_m": 0.6365, "shielded_lateral_m": 0.5151, "kept_lateral_m": 0.1812,
            "over_corridor": 0.8503,
        },
    }  # fmt: skip
    outputs = {"position": {"alpha": 0.84384}}
    result = documents()["certificate.json"]
    boxes = result["boxes"] | {"state": [[-0.2, -0.1, 7.0], [0.3, 0.1, 11.0]]}
    return result | {"outputs": outputs, "boxes": boxes, "corridor": corridor | changes}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    run = write_run(tmp_path_factory.mktemp("corridor"), certificate=certificate())
    result, made = report_of(run)
    return text_of(result), made


@pytest.mark.parametrize(
    "words",
    [
        "the car stays within 0.2132 m of its path as long as it drives at 8 to 10.5 m/s on a road of a curvature of "
        "at most 0.02 1/m",
        "a lateral acceleration of at most 2 m/s²; friction lies in 0.3 to 0.9, side wind in −8 to 8 m/s, and they "
        "hold for at least 3 s between two switches",
        "at most 0.03 rad of steering and 1 m/s² of drive to the law, with a spread of 0.002 to 0.025 rad and 0.05 to "
        "0.6 m/s²; and the drive lasts at most 60 s. At least 95 % of such drives keep it.",
        "within W = 0.1112 m of the path; and the car stays within 0.1021 m of that copy while the disturbances",
        "brings two states to at most 0.8439 times their distance",
        "state: lateral deviation −0.2 to 0.3 m, heading error −0.1 to 0.1 rad, speed 7 to 11 m/s; control: steering",
        "on 97.33 % of the last all bounds hold (95 % interval of that fraction 0.933 to 0.993)",
        "on 96 % of 140 drives of S3, whose schedule no calibration saw (0.915 to 0.985)",
        "The test drives came to 0.093 m from the path and 0.050 m from their copy",
        "brought the car to 0.636 m from its path, and to 0.515 m with the shield",
        "the car came to 0.181 m, 0.85 times the corridor",
        "within 0.2512 m of its path under the law alone and within 0.4262 m whatever a planner commands",
        "0.2712 and 0.4462 m right after a switch",
        "measured on 67500 of them, not proved",
        "Certified corridor ± 0.2132 m",
        "heading [rad] 0.04211 95 %, with the others",
        "heading [rad] 0.0802 95 %, by itself",
    ],
)
def test_the_section_says_what_the_document_holds(page, words):
    assert words in page[0]


def test_bounds_are_rounded_up_and_what_is_measured_is_not_called_proved(page):
    section = page[0].split(HEADING)[1].split("What is certified")[0]
    proved = section.split("Proved.")[1].split("Measured, not proved.")[0]
    assert "0.8439" in proved
    assert not any(
        number in proved for number in ("0.2132", "0.1112", "0.1021", "95 %")
    )
    assert "0.2131 m" not in section


def test_the_corridor_is_drawn_around_the_drives_of_the_page(page):
    names = [figure.rsplit("/", 1)[-1] for figure in page[1]["figures"]]
    assert "corridor.png" in names


def test_no_corridor_no_section(tmp_path):
    for number, document in enumerate(
        (
            documents()["certificate.json"],
            certificate() | {"valid": False},
            certificate(corridor_m=None),
        )
    ):
        result = text_of(
            report_of(
                write_run(tmp_path / str(number), certificate=document, episodes=None)
            )[0]
        )
        assert HEADING not in result
        assert "Certified corridor" not in result


def test_missing_entries_read_as_an_en_dash(tmp_path):
    bare = certificate() | {
        "corridor": nulled(certificate()["corridor"]) | {"corridor_m": 0.21311}
    }
    for number, document in enumerate(
        (bare, certificate() | {"corridor": {"corridor_m": 0.21311}})
    ):
        result = text_of(
            report_of(
                write_run(tmp_path / str(number), certificate=document, episodes=None)
            )[0]
        )
        assert "within 0.2132 m" in result
        assert "at – to – m/s" in result
        assert "None" not in result
