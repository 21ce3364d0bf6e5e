"""Scores of hand-made episodes, their statistics, and the rows made of them."""

import jax
import numpy as np
import pytest

from sfkd_jax.evaluation import (
    Episode,
    compare,
    pool,
    row,
    score,
    summary,
)

DT, STEPS = 0.1, 200
TIME = np.arange(1, STEPS + 1) * DT
CALM = np.broadcast_to([0.9, 0.0], (1, STEPS, 2))


def episode(lateral, steering=None, states=None, ess=None, healthy=None):
    """One episode as a batch, with what matters given and the rest at rest."""
    steps = len(lateral)
    controls = np.zeros((1, steps, 2))
    controls[0, :, 0] = 0.0 if steering is None else steering
    return Episode(
        states=np.zeros((1, steps + 1, 4)) if states is None else states[None],
        controls=controls,
        lateral=np.asarray(lateral, dtype=float)[None],
        progress=np.zeros((1, steps)),
        assumed_envs=np.zeros((1, steps, 2)),
        signals={
            "effective_samples": np.full((1, steps), 1.0 if ess is None else ess),
            "healthy": np.full((1, steps), True if healthy is None else healthy),
        },
    )


def test_a_sinusoid_has_the_rmse_of_a_sinusoid():
    """Over whole periods: amplitude / √2."""
    scores = score(episode(0.3 * np.sin(2 * np.pi * TIME / 3.0)), CALM, dt=DT)
    np.testing.assert_allclose(scores["rmse_m"], [0.3 / np.sqrt(2)], rtol=1e-12)
    np.testing.assert_allclose(scores["max_deviation_m"], [0.3], rtol=0.01)


def test_the_first_two_seconds_do_not_count():
    lateral = np.where(TIME <= 2.0 + 1e-9, 5.0, 0.1)
    scores = score(episode(lateral), CALM, dt=DT)
    np.testing.assert_allclose(scores["rmse_m"], [0.1], rtol=1e-12)
    np.testing.assert_allclose(scores["max_deviation_m"], [0.1])
    assert not scores["departures"][0]
    late = np.where(TIME <= 2.1 + 1e-9, 5.0, 0.1)
    assert score(episode(late), CALM, dt=DT)["max_deviation_m"][0] == 5.0


def switching(steps=STEPS, when=100, channel=0, to=0.3):
    envs = np.array(np.broadcast_to([0.9, 0.0], (1, steps, 2)))
    envs[0, when:, channel] = to
    return envs


def test_exactly_the_three_seconds_after_a_switch_are_scored_apart():
    """e_100 is the first after the switch; what it does is seen in the deviation of
    x_101, which is lateral[100].
    """
    lateral = np.zeros(STEPS)
    lateral[100:130] = 0.2
    scores = score(episode(lateral), switching(), dt=DT)
    np.testing.assert_allclose(scores["rmse_after_switch_m"], [0.2], rtol=1e-12)
    lateral[99] = lateral[130] = 7.0
    np.testing.assert_allclose(
        score(episode(lateral), switching(), dt=DT)["rmse_after_switch_m"],
        [0.2],
        rtol=1e-12,
    )
    lateral[129] = 0.0
    assert score(episode(lateral), switching(), dt=DT)["rmse_after_switch_m"][0] < 0.2


@pytest.mark.parametrize(
    ("channel", "to", "counts"),
    [
        (0, 0.3, True),
        (0, 0.88, False),
        (1, 8.0, True),
        (1, -8.0, True),
        (1, 5.0, False),
    ],
)
def test_a_switch_is_a_jump_of_friction_or_wind(channel, to, counts):
    scores = score(episode(np.ones(STEPS)), switching(channel=channel, to=to), dt=DT)
    assert np.isnan(scores["rmse_after_switch_m"][0]) != counts


def test_a_switch_during_settling_is_scored_from_the_end_of_settling_on():
    lateral = np.where(TIME <= 2.0 + 1e-9, 9.0, 0.5)
    np.testing.assert_allclose(
        score(episode(lateral), switching(when=10), dt=DT)["rmse_after_switch_m"], [0.5]
    )


def test_smoothness_is_the_mean_steering_rate():
    ramp = score(episode(np.zeros(STEPS), steering=0.05 * TIME), CALM, dt=DT)
    np.testing.assert_allclose(ramp["smoothness_rad_per_s"], [0.05], rtol=1e-9)
    zigzag = score(
        episode(np.zeros(STEPS), steering=0.01 * (np.arange(STEPS) % 2)), CALM, dt=DT
    )
    np.testing.assert_allclose(zigzag["smoothness_rad_per_s"], [0.01 / DT], rtol=1e-9)
    assert (
        score(episode(np.zeros(STEPS), steering=np.full(STEPS, 0.3)), CALM, dt=DT)[
            "smoothness_rad_per_s"
        ][0]
        == 0.0
    )


@pytest.mark.parametrize(
    ("deviation", "departed"),
    [(0.84, False), (-0.84, False), (0.86, True), (-3.0, True), (np.nan, True)],
)
def test_a_car_departs_when_its_side_leaves_the_lane(deviation, departed):
    """A lane of 3.5 m and a car of 1.8 m leave 0.85 m to either side."""
    lateral = np.zeros(STEPS)
    lateral[150] = deviation
    assert score(episode(lateral), CALM, dt=DT)["departures"][0] == departed


@pytest.mark.parametrize("when", [0, 5, STEPS])
def test_a_state_that_is_not_finite_is_a_departure_whenever_it_happens(when):
    states = np.zeros((STEPS + 1, 4))
    states[when, 3] = np.nan
    assert score(episode(np.zeros(STEPS), states=states), CALM, dt=DT)["departures"][0]


def test_an_episode_shorter_than_three_seconds_is_scored():
    scores = score(episode(np.full(25, 0.2)), switching(steps=25, when=15), dt=DT)
    np.testing.assert_allclose(
        [scores["rmse_m"][0], scores["rmse_after_switch_m"][0]], [0.2, 0.2]
    )


# --- statistics ------------------------------------------------------------------------------------------------------


def test_the_interval_of_a_constant_is_that_constant():
    result = summary(np.full(7, 0.25))
    assert result == {
        "mean": 0.25,
        "std": 0.0,
        "ci95": [0.25, 0.25],
        "median": 0.25,
        "p95": 0.25,
        "worst": 0.25,
    }


def test_a_single_episode_has_no_spread():
    assert summary(np.asarray([0.3]))["std"] is None


def test_a_summary_holds_what_it_says():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    result = summary(values)
    np.testing.assert_allclose(result["mean"], values.mean())
    np.testing.assert_allclose(result["std"], values.std(ddof=1))
    np.testing.assert_allclose(
        [result["median"], result["p95"]], np.quantile(values, [0.5, 0.95])
    )
    half = 1.96 * values.std() / np.sqrt(400)
    np.testing.assert_allclose(
        result["ci95"], [values.mean() - half, values.mean() + half], atol=0.1 * half
    )


# --- rows ------------------------------------------------------------------------------------------------------------


def about(system, **changes):
    return {
        "system": system,
        "scenario": "s3",
        "vehicle": "kinematic",
        "sampling": "feedback",
        "env": "measured",
        "variation": None,
        "seeds": [0],
        **changes,
    }


def scored(level, count=4):
    parts = [episode(np.full(STEPS, level * (1 + 0.1 * k))) for k in range(count)]
    batch = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return score(batch, np.broadcast_to(CALM, (count, STEPS, 2)), dt=DT)


def test_a_row_holds_every_measure_and_null_for_what_does_not_apply():
    made = row(scored(0.1), about("sfkd"), (1.5, 2.5), {"v0": 0.0})
    keys = {
        "rmse_m",
        "max_deviation_m",
        "rmse_after_switch_m",
        "smoothness_rad_per_s",
        "violation",
        "departures",
        "ess",
    }
    assert keys | {"act_ms", "ratio_to_oracle", "difference_to_sfkd"} | set(
        about("")
    ) <= set(made)
    np.testing.assert_allclose(made["rmse_m"]["mean"], 0.115)
    np.testing.assert_allclose(made["max_deviation_m"], 0.13)
    assert made["rmse_after_switch_m"] is None
    assert made["violation"] == {"v0": 0.0}
    assert made["departures"] == 0
    assert made["act_ms"] == {"p50": 1.5, "p99": 2.5}
    assert row(scored(2.0), about("sfkd"), None, {})["act_ms"] is None
    assert row(scored(2.0), about("sfkd"), None, {})["departures"] == 4


def test_comparisons_are_ratios_to_the_oracle_and_paired_differences_to_ours():
    scores = {"oracle": scored(0.1), "sfkd": scored(0.2), "nominal": scored(0.5)}
    rows = {name: row(value, about(name), None, {}) for name, value in scores.items()}
    compared = {entry["system"]: entry for entry in compare(list(rows.values()))}
    np.testing.assert_allclose(
        [compared[name]["ratio_to_oracle"] for name in scores], [1.0, 2.0, 5.0]
    )
    assert compared["sfkd"]["difference_to_sfkd"] is None
    np.testing.assert_allclose(
        compared["nominal"]["difference_to_sfkd"]["mean"], 0.3 * 1.15
    )
    assert compared["oracle"]["difference_to_sfkd"]["ci95"][1] < 0


def test_without_oracle_or_ours_nothing_is_compared():
    (only,) = compare([row(scored(0.5), about("nominal"), None, {})])
    assert only["ratio_to_oracle"] is None
    assert only["difference_to_sfkd"] is None


@pytest.mark.parametrize(
    "change",
    [
        {"scenario": "s1"},
        {"vehicle": "dynamic"},
        {"variation": "late"},
        {"sampling": "plain"},
    ],
)
def test_rows_that_drove_other_episodes_or_sampled_otherwise_are_not_paired(change):
    ours = row(scored(0.2), about("sfkd"), None, {})
    (_, other) = compare([ours, row(scored(0.5), about("icode", **change), None, {})])
    assert other["difference_to_sfkd"] is None


def test_two_trainings_of_three_episodes_are_not_paired_with_three_of_two():
    ours = pool(
        [
            row(scored(0.2, count=3), about("sfkd", seeds=[k]), None, {})
            for k in range(2)
        ]
    )
    theirs = pool(
        [
            row(scored(0.5, count=2), about("icode", seeds=[k]), None, {})
            for k in range(3)
        ]
    )
    assert compare([ours, theirs])[1]["difference_to_sfkd"] is None


def test_a_quadratic_program_is_paired_with_what_samples_around_feedback():
    rows = [
        row(scored(level), about("sfkd", sampling=name), None, {})
        for name, level in (("plain", 0.1), ("feedback", 0.2))
    ]
    compared = compare(
        [*rows, row(scored(0.5), about("koopman_mpc", sampling=None), None, {})]
    )
    np.testing.assert_allclose(compared[-1]["difference_to_sfkd"]["mean"], 0.3 * 1.15)


def test_pooling_joins_the_episodes_of_all_seeds_and_averages_the_rest():
    levels = (0.1, 0.3)
    made = [
        row(scored(level), about("sfkd", seeds=[k]), None, {"v0": level})
        for k, level in enumerate(levels)
    ]
    pooled = pool(made)
    assert pooled["seeds"] == [0, 1]
    assert (
        pooled["rmse_episodes_m"]
        == made[0]["rmse_episodes_m"] + made[1]["rmse_episodes_m"]
    )
    np.testing.assert_allclose(pooled["rmse_m"]["mean"], 0.2 * 1.15)
    np.testing.assert_allclose(pooled["rmse_trainings_m"], [0.1 * 1.15, 0.3 * 1.15])
    np.testing.assert_allclose(pooled["violation"]["v0"], 0.2)
    np.testing.assert_allclose(pooled["max_deviation_m"], made[1]["max_deviation_m"])
    assert pooled["system"] == "sfkd"
    assert pooled["rmse_after_switch_m"] is None
    assert pool(made[:1]) == made[0]
