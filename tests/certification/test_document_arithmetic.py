"""The arithmetic of a document: boxes, statistics and tubes, with a verified proof.

`benchmarks/robustness/mutants.py` runs these tests against mutants of `_document`;
`test_document.py` tests the whole chain.
"""

import copy
import inspect
import json
import math
from functools import cache

import numpy as np
import pytest
from helpers import entry_at, put

from sfkd_jax import demo
from sfkd_jax.certification import (
    CertificateStale,
    CertificationRefused,
    _document,
    coverage_interval,
)
from sfkd_jax.certification._tube import (
    latent_tube,
    path_tube,
    physical_tube,
    ultimate_tube,
)
from sfkd_jax.types import Model

KINDS = ("kinematic", "dynamic", "path")
MODEL = Model._make((None,) * len(Model._fields))
every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(autouse=True)
def proof_is_verified(monkeypatch):
    """`verify_document` without `verify` and without weights."""
    calls = []
    monkeypatch.setattr(_document, "exported", lambda model, params: "weights")
    monkeypatch.setattr(
        _document, "verify", lambda *given, **named: calls.append((given, named))
    )
    return calls


@cache
def honest(kind="kinematic"):
    """A document that ships; that of a policy along a path has the same numbers and
    another tube.
    """
    if kind != "path":
        return json.loads((demo.SHIPPED / kind / "certificate.json").read_text()) | {
            "witnesses": {}
        }
    document = copy.deepcopy(honest("kinematic"))
    del document["lipschitz"]["decoder"]
    alpha, d_bar, tube = document["alpha"], document["d_bar"], document["tube"]
    known = {
        "alpha": alpha,
        "lipschitz": document["lipschitz"],
        "residual": d_bar["one_step"],
    }
    tube["physical"] = path_tube(latent_tube(alpha, d_bar["value"], 20), **known)
    tube["for_ever"] = ultimate_tube(d_bar["value"] / (1 - alpha), **known)
    return document | {
        "tube": tube | {"largest_increment_m": None},
        "decoder_lipschitz": None,
    }


def check(document, sha=None):
    sha = document["policy_sha256"] if sha is None else sha
    inspect.unwrap(_document.verify_document)(
        document, {}, model=MODEL, policy_sha256=sha
    )


def refused(document, message):
    with pytest.raises(CertificationRefused) as reason:
        check(document)
    assert message in str(reason.value)
    assert "\n" not in str(reason.value)


@every_kind
def test_honest_documents_hold_and_their_proof_is_verified(kind, proof_is_verified):
    check(honest(kind))
    (((proof, params), named),) = proof_is_verified
    assert (proof.alpha, proof.witnesses) == (
        honest(kind)["alpha"],
        honest(kind)["witnesses"],
    )
    assert (params, named) == ({}, {"model": MODEL, "weights": "weights"})


def test_a_refusal_says_its_reason_and_other_weights_are_stale():
    for value in (False, None, 1, "true"):
        refused(honest() | {"valid": value, "reason": "alpha = 2.0"}, "alpha = 2.0")
    for sha in ("0" * 64, "f" * 64, ""):
        with pytest.raises(CertificateStale, match="about other weights or settings"):
            check(honest(), sha)


@pytest.mark.parametrize("name", ["state", "control", "env"])
def test_boxes_are_a_lower_and_an_upper_corner(name):
    low, high = entry_at(honest(), f"boxes.{name}")
    swapped = [[*low[:-1], high[-1]], [*high[:-1], low[-1]]]
    for corners in (swapped, [low], [low, high, high], [0.0, 1.0], [[low], [high]]):
        refused(
            put(honest(), f"boxes.{name}", corners),
            f"boxes.{name} is not a lower and an upper corner",
        )
    for value in (math.nan, math.inf, "0.5", None, 1j):
        corners = [[value] * len(low), high]
        refused(
            put(honest(), f"boxes.{name}", corners),
            f"boxes.{name} must be finite numbers",
        )
    refused(
        put(honest(), f"boxes.{name}", [[False], [True]]),
        f"boxes.{name} must be finite numbers",
    )


def test_a_box_of_a_point_is_one_and_that_of_the_environments_is_the_certified_one():
    check(put(honest(), "boxes.state", [[10.0], [10.0]]))
    check(put(honest(), "boxes.control", [[-1, -4], [1, 3]]))
    refused(
        put(honest(), "boxes.env.0.0", 0.31),
        "boxes.env is not the box that was certified",
    )
    refused(
        put(honest(), "env_box.1.1", 8.5), "boxes.env is not the box that was certified"
    )


@pytest.mark.parametrize(
    "bounds",
    [
        [1.0] * 3,
        [1.0] * 5,
        [1.0, 0.0, 1.0, 1.0],
        [1.0, 1.0, 1.0, -1e-9],
        [[1.0] * 4],
        1.0,
    ],
)
def test_the_bounds_of_a_monitor_are_four_numbers_above_zero(bounds):
    refused(
        put(honest(), "monitor.bounds", bounds),
        "measured bounds must be four numbers above 0",
    )


def test_a_measured_error_may_be_zero_and_not_less():
    refused(
        put(honest(), "d_bar.one_step.body", -5e-324),
        "measured bounds must be four numbers above 0",
    )
    refused(
        put(honest(), "d_bar.one_step.body", 0.0), "tube.physical.body does not follow"
    )
    refused(
        put(honest(), "d_bar.one_step.yaw", math.nan),
        "d_bar.one_step must be finite numbers",
    )
    check(put(honest(), "monitor.bounds", [1, 5e-324, 1, 2]))


@pytest.mark.parametrize("part", ["d_bar", "monitor"])
def test_a_level_is_one_that_so_many_trajectories_support(part):
    for level in (0.0, 1.0, -0.5, 1.5, 0.999, math.nan):
        message = f"{part}.level = {level!r} is not possible with 600 trajectories"
        refused(put(honest(), f"{part}.level", level), message)
    for level in (0.001, 0.5, 0.998):
        check(put(honest(), f"{part}.level", level))


def test_there_are_at_least_as_many_trajectories_as_drives():
    for drives in (0, -1, 601):
        message = f"d_bar.drives = {drives} does not fit 600 trajectories"
        refused(put(honest(), "d_bar.drives", drives), message)
    for drives in (1, 599, 600):
        check(put(honest(), "d_bar.drives", drives))


COVERAGES = (
    "d_bar",
    "d_bar.by_scenario.s1",
    "d_bar.by_scenario.s2",
    "d_bar.by_scenario.s3",
)


def covered(path, inside, count, drives):
    """The document with another coverage, and the interval that belongs to it."""
    share = inside / count
    parts = {
        "coverage": share,
        "coverage_trajectories": count,
        "coverage_drives": drives,
    }
    document = honest()
    for name, value in (
        parts | {"coverage_ci95": coverage_interval(share, drives)}
    ).items():
        document = put(document, f"{path}.{name}", value)
    return document


@pytest.mark.parametrize("path", COVERAGES)
def test_a_coverage_is_a_share_of_trajectories_with_the_interval_of_its_drives(path):
    name = path.rpartition(".")[2]
    for inside, count, drives in ((0, 40, 40), (40, 40, 1), (39, 40, 13), (1, 1, 1)):
        check(covered(path, inside, count, drives))
    for inside, drives in ((-1, 40), (41, 40), (20, 41)):
        refused(
            covered(path, inside, 40, drives),
            f"{name}: a coverage of {inside / 40!r} is not possible with 40 trajectories",
        )
    drives = put(covered(path, 20, 40, 40), f"{path}.coverage_drives", 0)
    refused(drives, f"{name}: a coverage of 0.5 is not possible with 40 trajectories")
    document = covered(path, 20, 40, 20)
    refused(
        put(document, f"{path}.coverage", 0.5 + 1e-8),
        f"{name}: coverage does not follow",
    )
    for side in (0, 1):
        interval_path = f"{path}.coverage_ci95.{side}"
        moved = put(
            document, interval_path, entry_at(document, interval_path) * (1 + 1e-8)
        )
        refused(moved, f"{name}: coverage_ci95 does not follow")
    refused(
        put(document, f"{path}.coverage_drives", 40),
        f"{name}: coverage_ci95 does not follow",
    )


@every_kind
def test_every_radius_is_computed_again(kind):
    """To 1e-9: another order of summation moves it by less."""
    radii = [f"tube.latent.{k}" for k in range(20)] + ["tube.ultimate"]
    radii += [
        f"tube.physical.{name}.{k}"
        for name in ("position_m", "yaw_rad", "body")
        for k in range(20)
    ]
    if kind == "path":
        radii += [f"tube.for_ever.{name}" for name in ("position_m", "yaw_rad", "body")]
    for path in radii:
        value, message = (
            entry_at(honest(kind), path),
            path.rstrip("0123456789").rstrip("."),
        )
        for factor in (0.5, 1 - 2e-9, 1 + 2e-9, math.nan):
            refused(put(honest(kind), path, factor * value), message)
        for factor in (1 - 0.5e-9, 1 + 0.5e-9):
            check(put(honest(kind), path, factor * value))


@every_kind
def test_every_radius_follows_from_alpha_d_bar_and_the_constants(kind):
    document = honest(kind)
    refused(
        put(document, "alpha", document["alpha"] * (1 - 1e-6)),
        "tube.latent does not follow",
    )
    moved = put(document, "d_bar.value", 1.001 * document["d_bar"]["value"])
    refused(moved, "d_bar.value does not follow")
    refused(
        put(moved, "d_bar.one_step.latent", moved["d_bar"]["value"]),
        "tube.latent does not follow",
    )
    for name, radius in (
        ("position", "position_m"),
        ("yaw", "yaw_rad"),
        ("body", "body"),
    ):
        for path in (f"lipschitz.{name}", f"d_bar.one_step.{name}"):
            refused(
                put(document, path, 1.001 * entry_at(document, path)),
                "does not follow from the rest of the document",
            )
        shorter = put(
            document,
            f"tube.physical.{radius}",
            document["tube"]["physical"][radius][:-1],
        )
        refused(shorter, f"tube.physical.{radius} does not follow")
    refused(put(document, "tube.latent", document["tube"]["latent"][:-1]), "tube.")
    refused(
        put(document, "tube.ultimate", [document["tube"]["ultimate"]]),
        "tube.ultimate does not follow",
    )


def test_a_tube_has_the_parts_of_its_kind():
    message = "tube is not of position, yaw and body state"
    for kind in KINDS:
        refused(put(honest(kind), "tube.physical.height", [0.0] * 20), message)
        less = copy.deepcopy(honest(kind))
        del less["tube"]["physical"]["yaw_rad"]
        refused(less, message)
    refused(put(honest(), "tube.for_ever", {}), message)
    refused(put(honest("path"), "tube.for_ever", None), message)
    length = honest()["tube"]["largest_increment_m"]
    refused(put(honest(), "tube.largest_increment_m", -length), message)
    alpha, d_bar = honest()["alpha"], honest()["d_bar"]
    known = {
        "alpha": alpha,
        "lipschitz": honest()["lipschitz"],
        "residual": d_bar["one_step"],
    }
    shorter = physical_tube(
        latent_tube(alpha, d_bar["value"], 20), **known, largest_increment=0.1
    )
    check(put(put(honest(), "tube.physical", shorter), "tube.largest_increment_m", 0.1))
    refused(
        put(put(honest(), "tube.physical", shorter), "tube.largest_increment_m", -0.1),
        message,
    )
    for other in (0.0, 1.001 * length):
        refused(
            put(honest(), "tube.largest_increment_m", other),
            "tube.physical.position_m does not follow",
        )
    refused(
        put(honest(), "tube.largest_increment_m", None),
        "tube.largest_increment_m must be finite numbers",
    )


FORMS = ("for_ever", "followed")


def output(alpha, coverages=(0.95, 0.9), drives=60):
    """The document's part about one output."""
    shares = dict(zip(FORMS, coverages, strict=True))
    return {
        "alpha": alpha,
        "lipschitz": 2.0,
        "witness": {"metric": [[4.0]], "joint": [[[1.0, 2.0]]]},
        "tube": {"for_ever": 0.3, "followed": 0.2},
        "coverage": shares,
        "coverage_ci95": {
            form: coverage_interval(share, drives) for form, share in shares.items()
        },
        "coverage_drives": drives,
    }


@pytest.fixture
def outputs(monkeypatch):
    """A document with both outputs, and the recorded checks of their proofs."""
    calls = {"metric": [], "corridor": []}
    monkeypatch.setattr(
        _document, "require_output_metric", lambda *given: calls["metric"].append(given)
    )
    monkeypatch.setattr(
        _document, "require_corridor", lambda *given: calls["corridor"].append(given)
    )
    return honest("path") | {
        "outputs": {"position": output(0.8), "yaw": output(0.7)}
    }, calls


def test_every_output_is_proved_in_its_metric(outputs):
    document, calls = outputs
    check(document)
    assert calls["corridor"] == []
    assert [
        (name, claim.alpha, claim.lipschitz, weights)
        for name, claim, weights in calls["metric"]
    ] == [
        ("position", 0.8, 2.0, "weights"),
        ("yaw", 0.7, 2.0, "weights"),
    ]
    for _, claim, _ in calls["metric"]:
        np.testing.assert_array_equal(claim.metric, [[4.0]])
        np.testing.assert_array_equal(claim.joint, [[[1.0, 2.0]]])


def test_without_outputs_none_is_proved(outputs):
    calls = outputs[1]
    for parts in ({}, {"outputs": {}}, {"outputs": {}, "corridor": None}):
        check(honest("path") | parts)
    assert calls == {"metric": [], "corridor": []}


def test_a_corridor_needs_both_outputs(outputs, monkeypatch):
    document, calls = outputs
    check(document | {"corridor": {"bounds": 1}})
    assert calls["corridor"] == [({"bounds": 1}, document["outputs"]["position"])]
    for nothing in ({"outputs": {}}, {}):
        refused(
            honest("path") | nothing | {"corridor": {}},
            "a corridor needs a metric of every output",
        )
    for names in ("position", "yaw"):
        message = f"outputs must be position and yaw, got {names}"
        refused(document | {"outputs": {names: output(0.8)}}, message)
    monkeypatch.setattr(
        _document,
        "require_corridor",
        lambda part, output: part["drives"] / part["count"],
    )
    refused(
        document | {"corridor": {"drives": 0, "count": 0}},
        "the certificate is malformed: division by zero",
    )
    more = document["outputs"] | {"body": output(0.8)}
    refused(
        document | {"outputs": more},
        "outputs must be position and yaw, got position, yaw, body",
    )


@pytest.mark.parametrize("name", ["position", "yaw"])
@pytest.mark.parametrize("form", FORMS)
def test_the_tube_of_an_output_is_above_zero_and_its_coverage_one_of_drives(
    outputs, name, form
):
    document, part = outputs[0], f"outputs.{name}"
    for radius in (0.0, -0.1):
        refused(
            put(document, f"{part}.tube.{form}", radius),
            f"{part}.tube.{form} is not a radius",
        )
    for radius in (math.nan, math.inf, None, "0.3"):
        refused(
            put(document, f"{part}.tube.{form}", radius),
            f"{part}.tube must be finite numbers",
        )
    check(put(document, f"{part}.tube.{form}", 5e-324))
    share = entry_at(document, f"{part}.coverage.{form}")
    refused(
        put(document, f"{part}.coverage.{form}", share + 1e-8),
        f"{part}: coverage does not follow",
    )
    for other in (share - 1 / 60, 1.5, -0.05):
        refused(
            put(document, f"{part}.coverage.{form}", other),
            f"{part}: coverage_ci95 does not follow",
        )
    for side in (0, 1):
        path = f"{part}.coverage_ci95.{form}.{side}"
        refused(
            put(document, path, entry_at(document, path) + 1e-8),
            f"{part}: coverage_ci95 does not follow",
        )
    for drives, message in (
        (0, "malformed"),
        (120, "coverage_ci95 does not follow"),
        (61, "coverage does not follow"),
    ):
        refused(put(document, f"{part}.coverage_drives", drives), message)


@every_kind
def test_the_constant_of_the_decoder_is_told_twice(kind):
    for value in (0.5, np.nextafter(honest()["decoder_lipschitz"], 1.0)):
        refused(
            put(honest(kind), "decoder_lipschitz", value),
            "decoder_lipschitz is not that of lipschitz",
        )
    other = None if kind != "path" else 0.2881115206386872
    refused(
        put(honest(kind), "decoder_lipschitz", other),
        "decoder_lipschitz is not that of lipschitz",
    )


@pytest.mark.parametrize(
    "path",
    [
        "boxes",
        "d_bar",
        "tube",
        "monitor",
        "d_bar.by_scenario.s1",
        "tube.physical",
        "boxes.env",
    ],
)
@pytest.mark.parametrize("value", [None, 3, "text\nof two lines", []])
def test_what_is_malformed_is_refused_in_one_line(path, value):
    refused(put(honest(), path, value), "")
    lacking = copy.deepcopy(honest())
    above, _, last = path.rpartition(".")
    del (entry_at(lacking, above) if above else lacking)[last]
    if path != "d_bar.by_scenario.s1":
        refused(lacking, f"the certificate is malformed: '{last}'")
