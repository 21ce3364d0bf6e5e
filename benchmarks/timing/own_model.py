"""The project's own model and task: SFKD in the size of conf/model/sfkd.yaml, random
weights, a bend to follow.
"""

from functools import partial

from benchmarks import harness
from benchmarks.timing import ours
from sfkd_jax.rollout import fold

SPEED, RADIUS = 10.0, 50.0
PLANT = "vehicle=dynamic"


def settings(*overrides):
    """The composed configuration of the commands, as plain settings."""
    import hydra
    from omegaconf import OmegaConf

    from sfkd_jax.experiment import command as config

    config.register()
    with hydra.initialize_config_dir(config.conf_path(), version_base="1.3"):
        return OmegaConf.to_container(
            hydra.compose("config", [PLANT, *overrides]), resolve=True
        )


def space(plant):
    """Scales about those of the plant's own drives."""
    import jax.numpy as jnp

    from sfkd_jax.types import Space

    body = len(plant.state_names) - 3
    numbers = {
        "body_mean": jnp.zeros(body).at[0].set(10.0),
        "body_scale": jnp.full(body, 0.5).at[0].set(4.0),
        "control_mean": [0.0, 0.2],
        "control_scale": [0.2, 2.0],
        "env_mean": [0.6, 0.0],
        "env_scale": [0.3, 8.0],
        "increment_mean": [1.0, 0.0, 0.0],
        "increment_scale": [0.3, 0.05, 0.1],
    }
    return Space(**{name: jnp.asarray(value) for name, value in numbers.items()})


def belief(*overrides):
    """Plant, model and settings under overrides of the configuration."""
    from sfkd_jax import build

    args = settings(*overrides)
    plant = build.build_vehicle(args["vehicle"])
    return plant, build.build_model(args["model"], space(plant), plant), args


def weights(model):
    """Random ones in the shape of the model's own, of unit gain."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    random = np.random.default_rng(1)

    def drawn(leaf):
        spread = leaf.shape[-2] ** -0.5 if len(leaf.shape) > 1 else 0.3
        return jnp.asarray(
            spread * random.standard_normal(leaf.shape), dtype=leaf.dtype
        )

    return jax.tree.map(drawn, jax.eval_shape(model.init, jax.random.key(0)))


def measured(plant, horizon):
    """Observation, environment and reference: into a bend, with side wind."""
    import jax.numpy as jnp

    angle = plant.dt * SPEED / RADIUS * jnp.arange(1, horizon + 1)
    speed = jnp.full(horizon, SPEED)
    reference = jnp.stack(
        [RADIUS * jnp.sin(angle), RADIUS * (1 - jnp.cos(angle)), angle, speed], axis=1
    )
    observation = jnp.zeros(len(plant.state_names)).at[3].set(SPEED)
    return observation, jnp.asarray([0.6, 2.0]), reference


def inputs(plant, model, horizon):
    """Random parameters, and what is measured."""
    return weights(model), *measured(plant, horizon)


def problem(samples, horizon, seed=0, **options):
    """The configured `Controller` under further options of `mppi`, and what its `act`
    takes.
    """
    import jax

    from sfkd_jax import build

    plant, model, args = belief()
    args["controller"]["mppi"] |= {
        "num_samples": samples,
        "horizon": horizon,
        **options,
    }
    limits = {f"env_{side}": args["environment"][side] for side in ("low", "high")}
    controller = build.build_controller(args["controller"], model, plant, **limits)
    params, *rest = inputs(plant, model, horizon)
    params = jax.jit(partial(fold, model))(params)
    return controller, (params, controller.init(jax.random.key(seed)), *rest)


def own_model(samples, horizon, seed=0, **options):
    """A contender by itself, with a problem of its own: state and target that it is
    given are not looked at.
    """
    import jax
    import numpy as np

    controller, (params, state, *rest) = problem(samples, horizon, seed, **options)
    act, memory = jax.jit(controller.act), [state]

    def step(z, target):
        u, memory[0], _ = act(params, memory[0], *rest)
        return np.asarray(u)

    return step


def own_model_ess(samples, horizon, seed=0):
    """The same with a temperature that is found for 30 effective samples."""
    return own_model(samples, horizon, seed, effective_samples=30.0)


def own_model_sharded(samples, horizon, seed=0):
    """The same with its samples on as many host devices as there are cores."""
    return own_model(samples, horizon, seed, sharding=ours.spread())


own_model_sharded.environment = harness.HOST_DEVICES
