"""A simulator that is not written in JAX and has every fault.

In a file of their own, which workers import.
"""

import os
import time

import gymnasium
import numpy as np

FAULTS = {
    1: "ZeroDivisionError: division by zero",
    2: "are not 5 finite numbers",
    3: "are not 5 finite numbers",
    4: "its process ended",
    5: "no answer in 1 s",
}
"""By the first entry of e; each kind is said once."""


class Faulty:
    """A point that turns; as a test wishes, it fails."""

    state_names = ("p_x", "p_y", "yaw", "v", "steps")
    control_low, control_high, timeout_s, workers = [-1, -2], [1, 2], 1, 2
    dt = np.float32(0.5)

    def reset(self, state):
        self.state = state

    def step(self, control, environment):
        print("is on stderr")
        match round(environment[0]):
            case 1:
                1 / 0  # noqa: B018
            case 2:
                return [1.0]
            case 3:
                return self.state * np.nan
            case 4:
                os._exit(1)
            case 5:
                time.sleep(60.0)
        x, y, yaw, v, steps = self.state
        x, y = x + v * np.cos(yaw) * self.dt, y + v * np.sin(yaw) * self.dt
        self.state = np.array([x, y, yaw + control[0], v + control[1], steps + 1.0])
        return self.state


class Small:
    """A car at a tenth, which turns without slip and counts what never settles."""

    state_names = ("p_x", "p_y", "yaw", "v", "odometer", "charge", "clock")
    control_low, control_high = (-0.4, -2.0), (0.4, 2.0)
    dt, wheelbase, speed, workers = 0.1, 0.27, (0.5, 3.0), 1

    def reset(self, state):
        self.state = state

    def step(self, control, environment):
        x, y, yaw, v, odometer, charge, clock = self.state
        way = v * self.dt
        turned = way * np.tan(control[0]) / self.wheelbase
        self.state = np.array(
            [
                x + way * np.cos(yaw + 0.5 * turned),
                y + way * np.sin(yaw + 0.5 * turned),
                yaw + turned,
                v + self.dt * control[1],
                odometer + way,
                charge - 1e-6,
                clock + self.dt,
            ]
        )
        return self.state


class Forgetful(Small):
    """The same with a servo that its names leave out."""

    state_names = Small.state_names[:4]

    def reset(self, state):
        self.state = np.append(state, np.zeros(3))
        self.steering = 0.0

    def step(self, control, environment):
        self.steering += 0.5 * (control[0] - self.steering)
        return super().step([self.steering, control[1]], environment)[:4]


class Remembering(Small):
    """The same, which names the servo as a state that no sensor shows."""

    state_names = Small.state_names[:4]
    hidden_names = (*Small.state_names[4:], "steering")

    def reset(self, state):
        self.state, self.steering = state[:-1], state[-1]

    def step(self, control, environment):
        self.steering += 0.5 * (control[0] - self.steering)
        after = super().step([self.steering, control[1]], environment)
        return np.append(after, self.steering)


class Backwards(Small):
    """The same with a range of speeds that is none."""

    speed = (3.0, 0.5)


class Gym(gymnasium.Env):
    """The same as an environment of gymnasium."""

    state_names, dt = Faulty.state_names, 0.5
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        self.inner, self.given = Faulty(), options["environment"]
        self.inner.reset(options["state"])
        return self.inner.state, {}

    def step(self, action):
        state = self.inner.step(action, self.given)
        return np.append(state, 99.0), 0.0, state[3] < 0.0, False, {}


def wrapped():
    return gymnasium.wrappers.TimeLimit(Gym(), max_episode_steps=1)
