"""Policies in path coordinates: law and weights are one artefact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TINY, any_law, path_space
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from sfkd_jax import build, plants, policy, store
from sfkd_jax.cli import config
from sfkd_jax.pipeline import dry_run


def settings(*overrides):
    config.register()
    with initialize_config_dir(config.conf_path(), version_base="1.3"):
        composed = compose("config", overrides=["+experiment=s3", *overrides])
    return {
        name: value
        for name, value in OmegaConf.to_container(composed, resolve=True).items()
        if name != "hydra"
    }


def saved(run_dir, *, law, samples=4):
    options = settings(
        "controller=mppi_tiny",
        "controller.sampling=law",
        f"controller.mppi.num_samples={samples}",
    )
    options["model"] |= {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in TINY.items()
    }
    options["model"] |= {"budget": "joint"}
    scales = path_space()
    model = build.build_model(options["model"], scales, plants.kinematic())
    options |= {"space": build.space_to_settings(scales)}
    return policy.save(
        run_dir / "policy.npz",
        model.init(jax.random.key(0)),
        options,
        made_from={},
        law=law,
    )


def test_the_law_is_stored_hashed_and_loaded_with_the_weights(tmp_path):
    (tmp_path / "other").mkdir()
    first = saved(tmp_path, law=any_law())
    faster = any_law()._replace(gain=1.1 * any_law().gain)
    assert saved(tmp_path / "other", law=faster)["sha256"] != first["sha256"]
    loaded = policy.load(tmp_path)
    assert "law" not in loaded.weights
    assert loaded.model.along_path
    for name, leaf in any_law()._asdict().items():
        np.testing.assert_array_equal(getattr(loaded.law, name), leaf)
    reference = jnp.stack(
        [0.9 * jnp.arange(1, 21), *(jnp.zeros((2, 20))), jnp.full(20, 9.0)], axis=1
    )
    act = jax.jit(loaded.controller.act)
    memory = loaded.controller.init(jax.random.key(1))
    control, _, info = act(
        loaded.params,
        memory,
        jnp.asarray([0.0, 0.2, 0.0, 9.0]),
        jnp.asarray([0.6, 0.0]),
        reference,
    )
    assert np.all(np.isfinite(control))
    assert bool(info["healthy"])


def test_a_policy_that_lost_its_law_is_refused(tmp_path):
    saved(tmp_path, law=None)
    with pytest.raises(store.ArtefactError, match=r"policy\.npz.*'law'"):
        policy.load(tmp_path)


@pytest.mark.parametrize(
    "overrides", [("dataset=standard",), ("model=sfkd", "controller=mppi")]
)
def test_path_coordinates_for_data_and_model_or_for_neither(overrides):
    options = settings(*overrides)
    with pytest.raises(ValueError, match="go together"):
        dry_run.check_settings(options, build.build_vehicle(options["vehicle"]))


def test_the_system_law_exists_in_path_coordinates_only():
    options = settings("evaluation.systems=[law]")
    dry_run.check_settings(options, build.build_vehicle(options["vehicle"]))
    with pytest.raises(ValueError, match=r"evaluation\.systems entry 'law'"):
        dry_run.check_settings(
            settings("dataset=standard", "model=sfkd", "evaluation.systems=[law]"),
            plants.kinematic(),
        )


@pytest.mark.parametrize(
    "model", ["sfkd_path", "sfkd_path_no_contraction", "neural_ode_path", "r2dn_path"]
)
def test_every_path_model_passes_the_dry_run_with_its_planner(model):
    options = settings(
        f"model={model}",
        *(() if "sfkd" in model and "no" not in model else ("training.loss.tube=[]",)),
    )
    dry_run.check_settings(options, build.build_vehicle(options["vehicle"]))
