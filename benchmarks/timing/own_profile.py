"""Where the control step with the project's own model spends its time: parts alone, and the rollouts less a part.

python -m benchmarks.timing.own_profile [--samples 1500 --horizon 20 --rounds 15 --out
benchmarks/timing/own_profile.json]
"""

import argparse
import json

import jax
import jax.numpy as jnp

from benchmarks import harness
from benchmarks.timing import own_model
from sfkd_jax import control
from sfkd_jax.control.planners._rollouts import Rollouts

SMALL = "[2]"


def task_of(plant, model, *, law=None, cost=None):
    """The path task of the configuration, or with another law or cost."""
    return control.path_tracking(
        model,
        cost or control.tracking_cost(dt=plant.dt),
        law or control.path_feedback(wheelbase=plant.wheelbase),
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
    )


def prepare_of(task):
    """What is evaluated once a step: fibre, encoder, curvature."""
    start = control.PlanningStart(jnp.zeros(2), jnp.asarray(False), jax.random.key(0))
    return jax.jit(lambda params, *measured: task.prepare(params, *measured, start))


def rollouts_of(task):
    """Costs and last states of all plans, as the planner computes them."""
    tuning = control.mppi(task).init(jax.random.key(0)).tuning

    @jax.jit
    def roll_out(setup, plans):
        rollouts = Rollouts(task, tuning, setup)(plans)
        return rollouts.costs, rollouts.states[-1]

    return roll_out


def whole(samples, horizon, **options):
    """The control step under further options of `mppi`."""
    controller, given = own_model.problem(samples, horizon, **options)
    return _call(jax.jit(controller.act), *given)


def rollouts(samples, horizon, *overrides, **changes):
    """Rollouts of a model and a task that are smaller than the real ones."""
    plant, model, _ = own_model.belief(*overrides)
    params, *measured = own_model.inputs(plant, model, horizon)
    task = task_of(plant, model, **changes)
    setup = prepare_of(task)(params, *measured)
    plans = 0.02 * jax.random.normal(jax.random.key(2), (horizon, samples, 2))
    return _call(rollouts_of(task), setup, plans)


def parts(samples, horizon):
    """Label -> a function of no arguments."""
    plant, model, _ = own_model.belief()
    given = own_model.inputs(plant, model, horizon)
    draw = control.noise_sampler("ar1", horizon=horizon)
    noise = jax.jit(lambda key: draw(key, samples, jnp.asarray([0.02, 0.3])))
    free = control.Cost({}, lambda weights, seen: jnp.zeros(()))
    bare = {"law": control.no_feedback(), "cost": free}
    return {
        "whole step": whole(samples, horizon),
        "whole step, 30 effective samples": whole(
            samples, horizon, effective_samples=30.0
        ),
        "whole step, gains from 32 samples": whole(samples, horizon, gain_samples=32),
        "whole step, one sample": whole(1, horizon),
        "fibre, encoder, curvature": _call(prepare_of(task_of(plant, model)), *given),
        "noise": _call(noise, jax.random.key(3)),
        "rollouts": rollouts(samples, horizon),
        "rollouts, one sample": rollouts(1, horizon),
        "rollouts less the residual": rollouts(samples, horizon, "model.residual=none"),
        "rollouts, decoder of width 2": rollouts(
            samples, horizon, f"model.decoder_hidden={SMALL}"
        ),
        "rollouts less the cost": rollouts(samples, horizon, cost=free),
        "rollouts less the law": rollouts(samples, horizon, law=control.no_feedback()),
        "rollouts less law and cost": rollouts(samples, horizon, **bare),
        "rollouts less all of these": rollouts(
            samples,
            horizon,
            "model.residual=none",
            f"model.decoder_hidden={SMALL}",
            **bare,
        ),
    }


def _call(run, *given):
    """Call and wait."""
    return lambda: jax.block_until_ready(run(*given))


def main():
    """Parse, time, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("samples", 1500), ("horizon", 20), ("rounds", 15)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--out")
    args = parser.parse_args()
    result = harness.in_turn(parts(args.samples, args.horizon), args.rounds)
    for label, row in result.items():
        print(
            f"{label:36}",
            "  ".join(f"{key} {value:7.3f}" for key, value in row.items()),
        )
    settings = {key: getattr(args, key) for key in ("samples", "horizon", "rounds")}
    harness.write(
        args.out, {"parts": result, "settings": settings, "machine": harness.machine()}
    )
    print(json.dumps(result["whole step"]))


if __name__ == "__main__":
    main()
