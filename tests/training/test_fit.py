"""The loss decreases; a run survives a kill, is reproducible, and stops at NaN."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TINY, VARIANTS, dataset, jit, largest_file, path_space

from sfkd_jax.data import measure_space, random_windows, spread_windows
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.models import sfkd
from sfkd_jax.training import (
    Checkpoints,
    TrainingStopped,
    descend,
    fit,
    multi_step_loss,
    planning_loss,
)
from sfkd_jax.training._losses import error_units
from sfkd_jax.types import BODY_FRAME, Trajectory

OPTIONS = {"steps": 40, "log_every": 10, "save_every": 20}
DRAW = partial(random_windows, batch=16, length=8)


@pytest.fixture(scope="module")
def task():
    """A model, its loss and its data."""
    data = dataset()
    space = measure_space(data)
    model = sfkd(space, **TINY)
    return model, multi_step_loss(model, space), data


def train(task, directory, seed=3, **changes):
    model, loss, data = task
    held_out = spread_windows(data.validation, length=8)
    return fit(
        model,
        loss,
        DRAW,
        data.train,
        held_out,
        jax.random.key(seed),
        directory,
        **(OPTIONS | changes),
    )


def same(a, b):
    return jax.tree.all(jax.tree.map(np.array_equal, a, b))


def lines(directory):
    return [
        json.loads(line)
        for line in (directory / "metrics.jsonl").read_text().splitlines()
    ]


@pytest.fixture(scope="module")
def unbroken(task, tmp_path_factory):
    """The directory, the weights and the best step of a run that nothing stops."""
    directory = tmp_path_factory.mktemp("unbroken")
    return directory, *train(task, directory)


def test_the_loss_falls_and_every_step_is_logged(unbroken):
    logged = lines(unbroken[0])
    assert [line["step"] for line in logged] == [10, 20, 30, 40]
    assert logged[-1]["loss"] < 0.8 * logged[0]["loss"]
    assert "validation_loss" in logged[1]


def test_what_validates_in_training_scores_its_result(task, unbroken):
    """One program: parameters read back are like those that were never stored."""
    _, loss, data = task
    before = loss.validate._cache_size()
    loss.validate(unbroken[1], spread_windows(data.validation, length=8))
    assert loss.validate._cache_size() == before


def test_an_interrupted_run_ends_bit_identical_to_an_unbroken_one(
    task, tmp_path, monkeypatch, unbroken
):
    """Where a loss is not finite, the last good checkpoint stays."""
    _, weights, best = unbroken
    saves = []
    save = Checkpoints.save

    def save_then_die(self, step, state, validation_loss):
        save(self, step, state, validation_loss)
        saves.append(step)
        raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoints, "save", save_then_die)
    with pytest.raises(KeyboardInterrupt):
        train(task, tmp_path / "broken")
    monkeypatch.undo()
    model, loss, data = task
    poisoned = loss._replace(
        evaluate=lambda *inputs: jax.tree.map(jnp.sqrt, (-1.0, {}, 0.0))
    )
    with pytest.raises(TrainingStopped, match="last good checkpoint is step 20"):
        train((model, poisoned, data), tmp_path / "broken")
    resumed, best_again = train(task, tmp_path / "broken")
    assert saves == [20]
    assert same(weights, resumed)
    assert best == best_again
    assert [line["step"] for line in lines(tmp_path / "broken")] == [10, 20, 30, 40]


def test_a_directory_holds_one_training_and_says_so(task, unbroken, capfd):
    """A cell of a notebook that is run again with a change gets no old weights."""
    directory, weights, best = unbroken
    model, loss, data = task
    resumed, best_again = train(task, str(directory))
    assert same(weights, resumed)
    assert best == best_again
    assert "training 40 / 40  resumed, finished" in capfd.readouterr().err
    other = data._replace(train=data.train._replace(controls=data.train.controls + 1))
    smaller = sfkd(measure_space(data), **TINY | {"rank": TINY["rank"] - 2})
    heavier = multi_step_loss(model, measure_space(data), one_step=2.0)
    for changed, options, message in (
        (task, {"seed": 4}, "key was"),
        (task, {"learning_rate": 1e-4}, "learning_rate was 0.003, is now 0.0001"),
        (task, {"steps": 60}, "steps was 40, is now 60"),
        ((model, loss, other), {}, "data was"),
        ((smaller, loss, data), {}, "parameters was"),
        ((model, heavier, data), {}, "loss before the first step was"),
    ):
        with pytest.raises(ValueError, match=f"holds another training .*{message}"):
            train(changed, directory, **options)
    assert capfd.readouterr().err == ""


def test_an_error_counts_by_the_lengths_and_distances_of_its_frame():
    """In a system of half the size a distance counts twice; half a width is as before."""
    model = sfkd(path_space(), **TINY, frame=PATH_FRAME)
    half = path_space().body_scale

    def units_in(frame, size):
        return error_units(model._replace(frame=frame), path_space(), size)

    expected = jnp.asarray([2.0, 2.0, 5.0, 2.0, 5.0, 0.05 / half[2]])
    np.testing.assert_allclose(units_in(PATH_FRAME, 0.5), expected, rtol=1e-6)
    expected = jnp.asarray([2.0, 2.0, 5.0, *(0.2 / half)])
    np.testing.assert_allclose(units_in(BODY_FRAME, 0.5), expected, rtol=1e-6)
    other = replace(PATH_FRAME, lengths=(0.0, 0.0, 0.0, 3.0), distances=(3,))
    expected = jnp.asarray([0.0, 0.0, 0.0, 6.0, *(0.05 / half[1:])])
    np.testing.assert_allclose(units_in(other, 0.5), expected, rtol=1e-6)
    longer = replace(PATH_FRAME, lengths=(1.0,) * 7)
    with pytest.raises(ValueError, match="lengths of 7 entries, and a state has 6"):
        units_in(longer, 1.0)


def test_what_planners_add_is_what_the_model_lacks():
    """Of a car whose e_y is blown aside; the model itself stays as it is."""
    model = sfkd(path_space(), **TINY | VARIANTS["state"], planning_residual=True)
    params, draw = jit(model.init)(jax.random.key(0)), np.random.default_rng(0)
    states = np.tile([0.0, 0.0, 0.0, 10.0, 0.0, 0.0], (16, 9, 1))
    controls = np.tile([0.01, 0.0, 0.0, 9.0], (16, 8, 1))
    envs = draw.uniform([0.3, -8.0], [0.9, 8.0], (16, 8, 2))
    states[:, 1:, 3] += 0.1 * envs[..., 1]
    data = jax.tree.map(jnp.asarray, Trajectory(states, controls, envs))
    loss, start = planning_loss(model, params, path_space()), params["planning"]
    one = partial(DRAW, length=1), data, jax.random.key(1)
    fitted = descend(start, loss, *one, steps=100)
    before, after = (loss.validate(weights, data)[0] for weights in (start, fitted))
    assert after < 0.5 * before


def test_the_score_of_a_window_does_not_depend_on_the_weights(task):
    """It is the prediction error with the default weights, of each window."""
    model, loss, data = task
    params, batch = model.init(jax.random.key(0)), spread_windows(data.test, length=8)
    other = multi_step_loss(
        model, measure_space(data), prediction=0.3, growth=2.0, consistency=5.0
    )
    total, parts, scores = loss.validate(params, batch)
    _, changed, again = other.validate(params, batch)
    np.testing.assert_allclose(scores, again, rtol=1e-6)
    assert changed["prediction"] < 0.9 * parts["prediction"]
    expected = parts["prediction"] + parts["one_step"]
    np.testing.assert_allclose(scores.mean(), expected, rtol=1e-5)
    assert total > expected


def test_latest_and_best_are_both_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step, score in ((1, 3.0), (2, 1.0), (3, 2.0), (4, 5.0)):
        checkpoints.save(step, {"w": jnp.full(3, float(step))}, score)
    assert (checkpoints.latest_step(), checkpoints.best_step()) == (4, 2)
    assert checkpoints.restore(2, {"w": jnp.zeros(3)})["w"][0] == 2.0
    checkpoints.close()
    reopened = Checkpoints(tmp_path)
    assert (reopened.latest_step(), reopened.best_step()) == (4, 2)
    reopened.close()


@pytest.mark.parametrize("size", [0, 1000])
def test_a_checkpoint_on_a_full_disk_is_one_line_and_leaves_the_one_before(
    tmp_path, capfd, size
):
    state = {"w": jax.random.normal(jax.random.key(0), (60, 60))}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state, 2.0)
    with (
        largest_file(size),
        pytest.raises(
            OSError, match=r"step 2 was not saved.*File too large.*goes on"
        ) as caught,
    ):
        checkpoints.save(2, state, 1.0)
    assert "\n" not in str(caught.value)
    assert "Traceback" not in capfd.readouterr().err
    checkpoints.close()
    reopened = Checkpoints(tmp_path)
    assert reopened.latest_step() == 1
    assert same(reopened.restore(1, state), state)
    reopened.save(2, state, 1.0)
    assert reopened.latest_step() == 2
    reopened.close()
