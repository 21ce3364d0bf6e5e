"""The 1/10 car of slipx as a simulator that a policy is trained for.

    PYTHONPATH=examples python -m sfkd_jax.train +experiment=s3 name=slipx \
        vehicle=simulator vehicle.env=slipx_car:make \
        'environment.low=[0.5,-3]' 'environment.high=[1.1,3]'

It needs `pip install slipx`. The environment is e = (grip [-], side force [N]): a
factor on the peaks of the tyre forces, and a push, as on a floor that slopes by 5°.
"""

import slipx

SUBSTEP = 0.005
"""Of the simulation [s]; a step of the controller is ten of them."""
LAGS = ("lag_fl", "lag_fr", "lag_rl", "lag_rr")
"""Slip angles that the tyres have reached [rad], one a wheel."""


class Slipx:
    """What `vehicle=simulator` asks of a simulator: names, `reset` and `step`.

    No sensor shows the servo and the lags of the tyres.
    """

    state_names = ("p_x", "p_y", "yaw", "v", "v_y", "yaw_rate")
    hidden_names = ("steering", "steering_rate", *LAGS)
    environment_names = ("grip [-]", "side force [N]")
    environment_roles = ("friction", "side_force")
    dt = 0.05
    wheelbase = 0.32
    speed = (1.5, 4.0)
    control_low = (-0.4, -2.5)
    control_high = (0.4, 5.0)

    def __init__(self):
        """Read the parameters of the reference car, which takes 30 ms."""
        self.parameters = slipx.load_reference_car().params
        self.peak = self.parameters.tyre_front.mu_x0, self.parameters.tyre_front.mu_y0

    def reset(self, state):
        """Put a car into a state, with a full battery."""
        x, y, yaw, v, v_y, yaw_rate, steering, steering_rate, *lags = map(float, state)
        self.state = slipx.VehicleState()
        self.state.pos.x = x
        self.state.pos.y = y
        self.state.yaw = yaw
        self.state.vel_body.x = v
        self.state.vel_body.y = v_y
        self.state.rates.z = yaw_rate
        self.state.steer = steering
        self.state.steer_rate = steering_rate
        self.state.alpha_lag = lags

    def step(self, control, environment):
        """The state `dt` later; control = (steering [rad], acceleration [m/s²])."""
        grip, side_force = map(float, environment)
        for tyre in (self.parameters.tyre_front, self.parameters.tyre_rear):
            tyre.mu_x0 = grip * self.peak[0]
            tyre.mu_y0 = grip * self.peak[1]
        car = slipx.VehicleModel.create(slipx.Tier.L2_DoubleTrack, self.parameters)
        steering, acceleration = map(float, control)
        command = slipx.DriveInput(steer_cmd=steering, accel_cmd=acceleration)
        push = side_force / self.parameters.mass * SUBSTEP
        state = self.state
        for _ in range(round(self.dt / SUBSTEP)):
            state.vel_body.y += push
            car.step(state, command, SUBSTEP)
        return (
            *(state.pos.x, state.pos.y, state.yaw),
            *(state.vel_body.x, state.vel_body.y, state.yaw_rate),
            *(state.steer, state.steer_rate),
            *state.alpha_lag,
        )


def make():
    """What the option `vehicle.env=slipx_car:make` names."""
    return Slipx()
