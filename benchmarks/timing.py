"""One control step of this library beside others, on one problem with the same weights.

    python -m benchmarks.timing [--rounds 3 --steps 40 --only NAME ...]

The problem is z⁺ = A z + B u + W₃ tanh(W₂ tanh(W₁ [z; u] + b₁) + b₂),
y = D₃ tanh(D₂ tanh(D₁ z)), with the cost |y − y_ref|² + 0.01 |u|², 1500 samples and 20 steps.
Every contender has a process of its own, one after the other. A library that does not
import is named and left out. The results go to benchmarks/timing.json.
"""

import json
import os
import platform
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib import metadata
from multiprocessing import get_context

import numpy as np

from benchmarks import arguments, stamp

RANK = 32
"""Length of the latent state z."""
CONTROLS = 2
OUTPUTS = 4
WIDTH = 64
"""Of the networks."""
NOISE = 0.4
"""Standard deviation of the samples, the same for each control."""
TEMPERATURE = 1.0
EFFORT = 0.01
"""Weight of |u|² in the cost."""
LOW = -2.0
HIGH = 2.0
SAMPLES = 1500
HORIZON = 20
WARM_UP = 9
"""Steps that are not timed."""
TARGET = np.zeros(OUTPUTS, np.float32)
START = np.random.default_rng(1).normal(size=RANK).astype(np.float32)
"""The latent state at the first step."""
PACKAGES = ("jax", "torch", "pytorch_mppi", "jax_mppi")


def weights():
    """The same for all contenders."""
    random = np.random.default_rng(0)

    def layer(out, size, scale=1.0):
        drawn = scale * random.normal(size=(out, size)) / np.sqrt(size)
        return drawn.astype(np.float32)

    rotation, _ = np.linalg.qr(random.normal(size=(RANK, RANK)))
    return {
        "A": (0.97 * rotation).astype(np.float32),
        "B": layer(RANK, CONTROLS, 0.3),
        "W1": layer(WIDTH, RANK + CONTROLS),
        "b1": np.zeros(WIDTH, np.float32),
        "W2": layer(WIDTH, WIDTH),
        "b2": np.zeros(WIDTH, np.float32),
        "W3": layer(RANK, WIDTH, 0.05),
        "D1": layer(WIDTH, RANK),
        "D2": layer(WIDTH, WIDTH),
        "D3": layer(OUTPUTS, WIDTH),
    }


def advance(xp, w, z, u):
    """z⁺ of one sample, or of samples as rows; xp is jax.numpy or torch."""
    hidden = xp.tanh(xp.concatenate((z, u), -1) @ w["W1"].T + w["b1"])
    residual = xp.tanh(hidden @ w["W2"].T + w["b2"]) @ w["W3"].T
    return z @ w["A"].T + u @ w["B"].T + residual


def charge(xp, w, z, u, target):
    """The cost of arriving at z by u, likewise."""
    y = xp.tanh(xp.tanh(z @ w["D1"].T) @ w["D2"].T) @ w["D3"].T
    return xp.sum((y - target) ** 2, -1) + EFFORT * xp.sum(u**2, -1)


def on_device():
    """The weights as jax arrays."""
    import jax.numpy as jnp

    return {name: jnp.asarray(value) for name, value in weights().items()}


def stepping(act, first):
    """`act(memory, z, target) -> u, memory`, jitted, with its memory kept."""
    import jax

    jitted = jax.jit(act)
    memory = first

    def step(z, target):
        nonlocal memory
        u, memory = jitted(memory, z, target)
        return np.asarray(u)

    return step


def sfkd_jax():
    """This library: white noise and a fixed temperature, as the others have them."""
    import jax
    import jax.numpy as jnp

    from sfkd_jax import control

    w = on_device()

    def dynamics(w, z, u, env):
        return advance(jnp, w, z, u)

    def stage(_, z, u, before, target):
        return charge(jnp, w, z, u, target)

    task = control.free_task(
        dynamics,
        stage,
        control_low=(LOW,) * CONTROLS,
        control_high=(HIGH,) * CONTROLS,
    )
    controller = control.mppi(
        task,
        num_samples=SAMPLES,
        horizon=HORIZON,
        noise="white",
        noise_std=(NOISE,) * CONTROLS,
        temperature=TEMPERATURE,
    )

    def act(memory, z, target):
        targets = jnp.tile(target, (HORIZON, 1))
        u, memory, _ = controller.act(w, memory, z, jnp.zeros(0), targets)
        return u, memory

    return stepping(act, controller.init(jax.random.key(0)))


def plain_jax():
    """What a user would write by hand: one scan, softmax, shift."""
    import jax
    import jax.numpy as jnp

    w = on_device()

    def act(memory, z, target):
        key, plan = memory
        key, draw = jax.random.split(key)
        noise = NOISE * jax.random.normal(draw, (HORIZON, SAMPLES, CONTROLS))
        plans = jnp.clip(plan[:, None] + noise, LOW, HIGH)

        def body(carry, controls):
            costs, states = carry
            states = advance(jnp, w, states, controls)
            costs = costs + charge(jnp, w, states, controls, target)
            return (costs, states), None

        first = jnp.zeros(SAMPLES), jnp.tile(z, (SAMPLES, 1))
        (costs, _), _ = jax.lax.scan(body, first, plans)
        shares = jax.nn.softmax(-costs / TEMPERATURE)
        plan = jnp.einsum("m,tmc->tc", shares, plans)
        return plan[0], (key, jnp.concatenate([plan[1:], plan[-1:]]))

    return stepping(act, (jax.random.key(0), jnp.zeros((HORIZON, CONTROLS))))


def jax_mppi():
    """jax_mppi inside one jit; it charges z_t where the others charge z_{t+1}."""
    import jax
    import jax.numpy as jnp
    from jax_mppi import mppi

    w = on_device()
    ones = jnp.ones(CONTROLS)
    config, first = mppi.create(
        RANK,
        CONTROLS,
        NOISE**2 * jnp.diag(ones),
        num_samples=SAMPLES,
        horizon=HORIZON,
        lambda_=TEMPERATURE,
        u_min=LOW * ones,
        u_max=HIGH * ones,
        key=jax.random.PRNGKey(0),
    )

    def act(memory, z, target):
        def cost(z, u):
            return charge(jnp, w, z, u, target)

        return mppi.command(config, memory, z, partial(advance, jnp, w), cost)

    return stepping(act, first)


def pytorch_mppi():
    """pytorch-mppi, eager, float32."""
    import pytorch_mppi as library
    import torch

    torch.manual_seed(0)
    w = {name: torch.as_tensor(value) for name, value in weights().items()}
    ones = torch.ones(CONTROLS)
    aim = None

    def cost(z, u):
        return charge(torch, w, z, u, aim)

    planner = library.MPPI(
        partial(advance, torch, w),
        cost,
        RANK,
        noise_sigma=NOISE**2 * torch.diag(ones),
        num_samples=SAMPLES,
        horizon=HORIZON,
        lambda_=TEMPERATURE,
        u_min=LOW * ones,
        u_max=HIGH * ones,
        U_init=torch.zeros(HORIZON, CONTROLS),
    )

    def step(z, target):
        nonlocal aim
        aim = torch.as_tensor(target)
        return planner.command(torch.as_tensor(z)).numpy()

    return step


CONTENDERS = {
    build.__name__: build for build in (sfkd_jax, plain_jax, jax_mppi, pytorch_mppi)
}


def measure(name, steps):
    """Seconds to the first answer, then the time of every warm step [ms]."""
    began = time.perf_counter()
    step = CONTENDERS[name]()
    step(START, TARGET)
    first = time.perf_counter() - began
    times = []
    for _ in range(WARM_UP + steps):
        began = time.perf_counter()
        step(START, TARGET)
        times.append(1e3 * (time.perf_counter() - began))
    return {"first_s": first, "times_ms": times[WARM_UP:]}


def in_own_process(name, steps):
    """`measure` in a new process; {"error": what it says} if it fails."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            return pool.submit(measure, name, steps).result()
        except Exception as error:
            return {"error": repr(error)}


def versions():
    """Of the packages that are installed."""
    found = {one.name.replace("-", "_"): one for one in metadata.distributions()}
    return {name: found[name].version for name in PACKAGES if name in found}


def main():
    """Parse, run, write."""
    options = arguments(__doc__, __file__, rounds=3, steps=40, only=CONTENDERS)
    # Another job beside a benchmark spoils its times: the load says whether there was.
    load = os.getloadavg()[0]
    rounds = {name: [] for name in options.only}
    for _ in range(options.rounds):
        for name in options.only:
            rounds[name].append(in_own_process(name, options.steps))
    rows = []
    left_out = {}
    for name, found in rounds.items():
        if errors := [one["error"] for one in found if "error" in one]:
            left_out[name] = errors[0]
            continue
        medians = [statistics.median(one["times_ms"]) for one in found]
        every = np.concatenate([one["times_ms"] for one in found])
        row = {
            "contender": name,
            "best_ms": round(min(medians), 2),
            "median_ms": round(statistics.median(medians), 2),
            "p99_ms": round(float(np.quantile(every, 0.99)), 2),
            "first_s": round(statistics.median(one["first_s"] for one in found), 2),
        }
        rows.append(row)
        print(row)
    print(left_out)
    document = {
        "cores": len(os.sched_getaffinity(0)),
        "processor": platform.machine(),
        "load": load,
        "versions": versions(),
        "left_out": left_out,
        **stamp(),
        "rows": rows,
    }
    options.out.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
