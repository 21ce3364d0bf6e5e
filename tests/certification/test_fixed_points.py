"""The corridor from fixed points: linear loops with known ones, and forgeries."""

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.certification import (
    FixedPoints,
    OutputMetric,
    fixed_point_corridor,
    fixed_points,
)
from sfkd_jax.certification._claims import Refuted
from sfkd_jax.certification._fixed_points import require_fixed_points
from sfkd_jax.types import Model

RATES = np.diag([0.8, 0.7, 0.6])
CONTROL = np.asarray(
    [[2.0, 0.1, 30.0, 0.01], [0.5, 0.3, -4.0, 0.0], [0.0, 0.2, 1.0, 0.02]]
)
ENVIRONMENT = np.asarray([[0.1, 0.02], [0.05, -0.01], [0.0, 0.03]])
METRIC = np.diag([4.0, 1.0, 9.0])
CLAIM = OutputMetric(0.8, 0.5, METRIC, [])
ENV_BOX = [[0.3, -8.0], [0.9, 8.0]]
LIMIT = np.asarray([0.03, 1.0])


def linear(rates=RATES, control=CONTROL, environment=ENVIRONMENT):
    """z⁺ = A z + B w + E e, where z is (e_y, e_ψ, v) itself."""
    A, B, E = (jnp.asarray(part, dtype=float) for part in (rates, control, environment))
    return Model(
        init=lambda key: {},
        fiber=lambda params, env: env,
        encode=lambda fiber, state: state[3:],
        step=lambda fiber, latent, control: A @ latent + B @ control + E @ fiber,
        decode=lambda fiber, latent: jnp.concatenate([jnp.zeros(3), latent]),
        transport=lambda fiber, later, latent: latent,
        observe=lambda fiber, latent, state: state[3:],
        vector=lambda latent: latent,
        along_path=True,
    )


def roads(count=40, seed=0):
    """Steps of roads, (κ, v) before and after."""
    random = np.random.default_rng(seed)
    before = np.stack(
        [random.uniform(-0.02, 0.02, count), random.uniform(8.0, 10.5, count)], axis=1
    )
    return np.stack(
        [before, before + random.uniform(-1.0, 1.0, (count, 2)) * [0.004, 0.1]], axis=1
    )


def length(gaps):
    return np.sqrt(np.einsum("...i,ij,...j", gaps, METRIC, gaps))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_fixed_points_of_a_linear_loop_are_found(sign):
    """The signs of two columns decide which corners of E and of the box of ν are the
    farthest apart.
    """
    steps = roads()
    control, environment = CONTROL * [1, sign, 1, 1], ENVIRONMENT * [1, sign]
    measured = fixed_points(
        linear(control=control, environment=environment),
        {},
        CLAIM,
        jnp.asarray(steps, dtype=float),
        start=jnp.zeros(6),
        env_box=ENV_BOX,
        perturbation=jnp.asarray(LIMIT, dtype=float),
    )
    settled = np.linalg.inv(np.eye(3) - RATES)
    corners = np.asarray(
        [[friction, wind] for friction in (0.3, 0.9) for wind in (-8.0, 8.0)]
    )
    roads_only = steps @ (settled @ control[:, 2:]).T
    rests = roads_only[:, :, None] + corners @ (settled @ environment).T
    assert measured.centre_m == pytest.approx(np.max(np.abs(rests[..., 0])), rel=1e-4)
    assert measured.road == pytest.approx(
        np.max(length(roads_only[:, 1] - roads_only[:, 0])), rel=1e-4
    )
    far = settled @ environment @ (corners[None] - corners[:, None])[..., None]
    assert measured.switch == pytest.approx(np.max(length(far[..., 0])), rel=1e-4)
    nus = LIMIT * np.asarray([[1, 1], [1, -1]])
    assert measured.push == pytest.approx(
        np.max(length(nus @ control[:, :2].T)), rel=1e-4
    )
    assert measured.points == len(steps) * 2 * 25


def worst_drive(alpha, scale, road, switch, push, disturbance, every, steps=2000):
    """e_y against c'z* of z⁺ = α z + (1 − α) z* + ν + d on a line: everything drives it
    the same way.
    """
    rest, latent, errors = 0.0, 0.0, []
    for step in range(steps):
        latent = alpha * latent + (1.0 - alpha) * rest + (push + disturbance) / scale
        errors.append(latent - rest)
        rest -= (road + (switch if step % every == 0 else 0.0)) / scale
    return np.asarray(errors[steps // 2 :])


@pytest.mark.parametrize("every", [1, 4, 30])
@pytest.mark.parametrize("alpha", [0.5, 0.93])
def test_the_bound_is_attained_by_a_loop_on_a_line(alpha, every):
    """|z|_P = scale |z|, so L = 1 / scale; each of the four terms is needed in full,
    also right after a switch.
    """
    scale, sizes = 3.0, {"road": 0.2, "switch": 0.7, "push": 0.3}
    disturbance = 0.1
    errors = worst_drive(alpha, scale, **sizes, disturbance=disturbance, every=every)
    for_ever = (alpha * disturbance / (1.0 - alpha) + disturbance) / scale
    measured = FixedPoints(centre_m=0.05, **sizes, points=1)
    claimed = fixed_point_corridor(
        measured,
        alpha=alpha,
        lipschitz=1.0 / scale,
        for_ever=for_ever,
        steps_between_switches=every,
    )
    assert np.max(errors) + 0.05 == pytest.approx(
        claimed["after_switch_m"]["planner"], rel=1e-6
    )
    quiet = worst_drive(
        alpha,
        scale,
        **(sizes | {"push": 0.0, "switch": 0.0}),
        disturbance=disturbance,
        every=every,
    )
    assert np.max(quiet) + 0.05 == pytest.approx(claimed["corridor_m"]["law"], rel=1e-6)
    alone = worst_drive(
        alpha, scale, **(sizes | {"push": 0.0}), disturbance=disturbance, every=every
    )
    assert np.max(alone) + 0.05 == pytest.approx(
        claimed["after_switch_m"]["law"], rel=1e-6
    )


def test_a_loop_that_rests_on_its_path_whatever_happens_needs_its_tube_alone():
    still = linear(control=np.zeros((3, 4)), environment=np.zeros((3, 2)))
    measured = fixed_points(
        still,
        {},
        CLAIM,
        jnp.asarray(roads(), dtype=float),
        start=jnp.ones(6),
        env_box=ENV_BOX,
        perturbation=jnp.asarray(LIMIT, dtype=float),
    )
    claimed = fixed_point_corridor(
        measured, alpha=0.8, lipschitz=0.5, for_ever=0.2, steps_between_switches=30
    )
    assert claimed["after_switch_m"]["planner"] == pytest.approx(0.2, abs=1e-5)


def test_an_environment_box_of_unequal_corners_is_refused():
    with pytest.raises(ValueError, match="shorter"):
        fixed_points(
            linear(),
            {},
            CLAIM,
            jnp.asarray(roads(), dtype=float),
            start=jnp.zeros(6),
            env_box=[[0.3, -8.0], [0.9]],
            perturbation=jnp.asarray(LIMIT, dtype=float),
        )


CONSTANTS = {"alpha": 0.8, "lipschitz": 0.5}
SIZES = {"centre_m": 0.05, "road": 0.2, "switch": 0.7, "push": 0.3}


def part(points=10, steps_between_switches=30, **sizes):
    """A document's part whose corridors follow from its sizes and counts."""
    return fixed_point_corridor(
        FixedPoints(**(SIZES | sizes), points=points),
        **CONSTANTS,
        for_ever=0.2,
        steps_between_switches=steps_between_switches,
    )


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"points": 1},
        {"steps_between_switches": 1},
        dict.fromkeys(SIZES, 0.0),
    ],
)
def test_corridors_that_follow_are_accepted(changes):
    require_fixed_points(part(**changes), CONSTANTS, 0.2)


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("size", [-0.5, -1.0, 1, np.inf, np.nan])
def test_sizes_must_be_finite_and_not_negative_even_if_all_else_follows(name, size):
    with pytest.raises(Refuted, match="sizes and positive counts"):
        require_fixed_points(part(**{name: size}), CONSTANTS, 0.2)


@pytest.mark.parametrize("name", ["points", "steps_between_switches"])
@pytest.mark.parametrize("count", [-5, 2.0, True])
def test_counts_must_be_positive_integers_even_if_all_else_follows(name, count):
    with pytest.raises(Refuted, match="sizes and positive counts"):
        require_fixed_points(part() | {name: count}, CONSTANTS, 0.2)


@pytest.mark.parametrize("corridor", ["corridor_m", "after_switch_m"])
@pytest.mark.parametrize("name", ["law", "planner"])
def test_no_corridor_may_be_missing_or_smaller(corridor, name):
    stated = part()[corridor]
    for forged in (
        {key: value for key, value in stated.items() if key != name},
        stated | {name: stated[name] * (1 - 1e-8)},
    ):
        with pytest.raises(Refuted, match=f"fixed_points.{corridor} does not follow"):
            require_fixed_points(part() | {corridor: forged}, CONSTANTS, 0.2)
