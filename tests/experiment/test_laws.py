"""Runs that a law lost are no failures of a simulator, and many failures end a command."""

import jax.numpy as jnp
import numpy as np
import pytest
from composing import run

from sfkd_jax.experiment import laws
from sfkd_jax.types import Trajectory

RUNS = 40
STEPS = 6


def runs(lost=(), failed=()):
    """Runs along a bend of 5 m; some leave it before they are not finite."""
    states = np.zeros((RUNS, STEPS + 1, 6), np.float32)
    states[..., 5] = 3.0
    controls = np.zeros((RUNS, STEPS, 4), np.float32)
    controls[..., 2] = 0.2
    for index in lost:
        states[index, 3, 3] = 4.5
        states[index, 4:] = np.nan
    for index in failed:
        states[index, 2:] = np.nan
    return Trajectory(*map(jnp.asarray, (states, controls, np.zeros((RUNS, STEPS, 2)))))


def test_a_run_that_the_law_lost_is_kept_and_one_that_failed_is_dropped(capsys):
    driven = runs(lost=(1, 2, 3, 4, 5), failed=(7,))
    kept, labels = laws.without_faults(driven, np.arange(RUNS), simulator=True)
    assert labels.tolist() == [index for index in range(RUNS) if index != 7]
    assert kept.states.shape[0] == RUNS - 1
    assert "the simulator failed in 1 of 40 runs" in capsys.readouterr().err
    (same,) = laws.without_faults(driven, simulator=False)
    assert same is driven
    (lost_alone,) = laws.without_faults(runs(lost=range(RUNS)), simulator=True)
    assert lost_alone.states.shape[0] == RUNS
    assert capsys.readouterr().err == ""


def test_more_failures_than_a_tenth_end_the_command():
    (kept,) = laws.without_faults(runs(failed=range(4)), simulator=True)
    assert kept.states.shape[0] == RUNS - 4
    with pytest.raises(ValueError, match="failed in 5 of 40 runs") as refused:
        laws.without_faults(runs(failed=range(5)), simulator=True)
    assert "\n" not in str(refused.value)
    # In the world there is no path that a run could have left.
    in_world = runs(failed=range(5))._replace(controls=jnp.zeros((RUNS, STEPS, 2)))
    with pytest.raises(ValueError, match="failed in 5 of 40 runs"):
        laws.without_faults(in_world, simulator=True)


SMALL = (
    "+experiment=s3",
    "vehicle=simulator",
    "vehicle.env=tests.driving.plants.simulators:Small",
    "environment.low=[0]",
    "environment.high=[1]",
    "dataset.law.model=plant",
    "dataset.law.points=[5,7,2]",
)


def derived(*words):
    source = run(*SMALL, *words).source
    return laws.derive_law(source.plant, source.along_path, source.box, simulator=True)


def test_a_law_of_the_plant_is_checked_and_states_that_never_settle_are_named(capsys):
    law = derived()
    said = capsys.readouterr().err
    assert "odometer, charge, clock never settle" in said
    assert "keeps vehicle own within" in said
    assert (np.asarray(law.state)[..., 3:] == 0.0).all()
    assert np.abs(np.asarray(law.gain)[..., 0, 0]).min() > 0.1
    with pytest.raises(ValueError, match="a tenth of its wheelbase: the weights"):
        derived("dataset.law.curvature=1e9")


VEHICLES = {
    "truck": (
        "vehicle.wheelbase=9",
        "vehicle.state_names=[p_x,p_y,yaw,v,v_y,yaw_rate,steering]",
        "vehicle.control_low=[-0.5,-4]",
        "vehicle.control_high=[0.5,1]",
    ),
    "robot": (
        "vehicle.wheelbase=0.5",
        "vehicle.control_low=[-0.5,-1]",
        "vehicle.control_high=[0.5,1]",
        "dataset.speed=[0.3,1.0]",
    ),
}


@pytest.mark.parametrize("name", VEHICLES)
def test_a_truck_and_a_robot_have_a_law_from_what_they_state(name):
    """The derivation refuses one that strays by more than a tenth of the wheelbase."""
    source = run(
        "+experiment=s3",
        "vehicle=own",
        f"vehicle.step=tests.experiment.vehicles:{name}",
        "dataset.law.model=plant",
        "dataset.law.points=[7,5,3]",
        *VEHICLES[name],
    ).source
    law = laws.derive_law(source.plant, source.along_path, source.box)
    gain = np.asarray(law.gain)
    assert (gain[..., 0, :2] > 0.0).all()
