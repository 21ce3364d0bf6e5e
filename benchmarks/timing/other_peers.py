"""Contenders in torch and numpy; each builds `step(z, target) -> u` on numpy arrays."""

import os
from functools import partial

import numpy as np

from benchmarks.timing import problem

ONE_THREAD = {"OMP_NUM_THREADS": "1"}


def pytorch_mppi(
    samples, horizon, seed=0, temperature=problem.TEMPERATURE, kind="MPPI", **options
):
    """pytorch-mppi, MPPI, eager, float32."""
    import pytorch_mppi as library
    import torch

    torch.manual_seed(seed)
    w, aim = _weights(torch), [None]
    cost = lambda z, u: problem.charge(torch, w, z, u, aim[0])
    ones = torch.ones(problem.CONTROLS)
    box = {
        "u_min": problem.LOW * ones,
        "u_max": problem.HIGH * ones,
        "U_init": torch.zeros(horizon, problem.CONTROLS),
    }
    size = {"num_samples": samples, "horizon": horizon, "lambda_": temperature}
    sigma = problem.NOISE**2 * torch.diag(ones)
    model = partial(problem.advance, torch, w)
    planner = getattr(library, kind)(
        model, cost, problem.RANK, noise_sigma=sigma, **size, **box, **options
    )

    def step(z, target):
        aim[0] = torch.as_tensor(target)
        return planner.command(torch.as_tensor(z)).numpy()

    return step


def pytorch_mppi_one_thread(samples, horizon, seed=0):
    """The same on one thread: no barrier between threads that another process can hold
    up.
    """
    return pytorch_mppi(samples, horizon, seed)


pytorch_mppi_one_thread.environment = ONE_THREAD


def pytorch_kmppi(samples, horizon, seed=0, temperature=problem.TEMPERATURE):
    """pytorch-mppi, KMPPI: five support points over the horizon."""
    return pytorch_mppi(
        samples, horizon, seed, temperature, kind="KMPPI", num_support_pts=5
    )


def torchrl_mppi(samples, horizon, seed=0):
    """torchrl's MPPIPlanner, one iteration, all samples kept (top_k); it starts anew,
    with unit noise, every step.
    """
    import torch
    from tensordict import TensorDict
    from torchrl.modules import MPPIPlanner

    torch.manual_seed(seed)
    aim = [None]
    environment = _torchrl_environment(aim)

    class Total(torch.nn.Module):
        def forward(self, result):
            total = result["next", "reward"].sum(-2, keepdim=True)
            return result.set("advantage", total.expand(result["next", "reward"].shape))

    size = {
        "planning_horizon": horizon,
        "optim_steps": 1,
        "num_candidates": samples,
        "top_k": samples,
    }
    planner = MPPIPlanner(
        environment, Total(), temperature=1.0 / problem.TEMPERATURE, **size
    )

    def step(z, target):
        aim[0] = torch.as_tensor(target)
        with torch.no_grad():
            return planner(TensorDict({"hidden": torch.as_tensor(z)}, []))[
                "action"
            ].numpy()

    return step


def _torchrl_environment(aim):
    """The problem as a torchrl environment of any batch size; `aim` holds the target."""
    import torch
    from tensordict import TensorDict
    from torchrl.data import Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase

    w = _weights(torch)

    class Latent(EnvBase):
        def __init__(self):
            super().__init__(batch_size=torch.Size([]))
            self.observation_spec = Composite(hidden=Unbounded((problem.RANK,)))
            self.state_spec = Composite(hidden=Unbounded((problem.RANK,)))
            self.action_spec = Bounded(problem.LOW, problem.HIGH, (problem.CONTROLS,))
            self.reward_spec = Unbounded((1,))

        batch_locked = False

        def _reset(self, tensordict):
            raise NotImplementedError

        def _set_seed(self, seed):
            return seed

        def _step(self, tensordict):
            z = problem.advance(torch, w, tensordict["hidden"], tensordict["action"])
            reward = -problem.charge(torch, w, z, tensordict["action"], aim[0])[
                ..., None
            ]
            done = torch.zeros(*z.shape[:-1], 1, dtype=torch.bool)
            result = {
                "hidden": z,
                "reward": reward,
                "done": done,
                "terminated": done.clone(),
            }
            return TensorDict(result, tensordict.batch_size)

    return Latent()


def tau_ctrl(samples, horizon, seed=0, temperature=problem.TEMPERATURE):
    """tau-ctrl, MPPI, numpy, the samples as one vector environment."""
    import gymnasium
    import tau_ctrl as library

    w = problem.weights()

    class Samples:
        def reset(self):
            pass

        def set_state(self, states):
            self.z = np.tile(states[0][0], (samples, 1))
            self.target = states[0][1]

        def step(self, controls):
            controls = controls.astype(np.float32)
            self.z = problem.advance(np, w, self.z, controls)
            never = np.zeros(samples, dtype=bool)
            return (
                self.z,
                -problem.charge(np, w, self.z, controls, self.target),
                never,
                never,
                {},
            )

    class One(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (problem.RANK,), np.float32
        )
        action_space = gymnasium.spaces.Box(
            problem.LOW, problem.HIGH, (problem.CONTROLS,), np.float32
        )
        state = (problem.start(), problem.TARGET)

        def get_state(self):
            return self.state

        def set_state(self, state):
            self.state = state

    one = One()
    size = {
        "horizon": horizon,
        "n_samples": samples,
        "noise_sigma": problem.NOISE,
        "temperature": temperature,
    }
    planner = library.make(
        "mppi", one, vector_env_fn=lambda count: Samples(), seed=seed, **size
    )

    def step(z, target):
        one.state = (z, target)
        return planner.predict(z)[0]

    return step


tau_ctrl.environment = {"OPENBLAS_NUM_THREADS": str(len(os.sched_getaffinity(0)))}


def _weights(torch):
    """The problem's, as tensors."""
    return {name: torch.as_tensor(value) for name, value in problem.weights().items()}
