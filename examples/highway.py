"""The dynamic bicycle of highway-env as a simulator that a policy is trained for.

    PYTHONPATH=examples python -m sfkd_jax.train +experiment=s3 name=highway \
        vehicle=simulator vehicle.env=highway:make \
        'environment.low=[0.35,-3]' 'environment.high=[1,3]'

It needs `pip install highway-env`. The environment is e = (grip [-], side force [kN]).
"""

from highway_env.vehicle.dynamics import BicycleVehicle

MASS = 1.5
"""Of the car [t]."""
FRICTION = 15.0
"""Friction coefficient of highway-env's tyres at grip 1."""
SUBSTEP = 0.05
"""Of the simulation [s]; a step of the controller is two of them."""


class Bicycle(BicycleVehicle):
    """The car of highway-env with a side force."""

    side_acceleration = 0.0

    def derivative_func(self, *given, **more):
        """Rates of the state; entry 4 is the lateral acceleration [m/s²]."""
        rates = super().derivative_func(*given, **more)
        rates[4] += self.side_acceleration
        return rates


class Highway:
    """What `vehicle=simulator` asks of a simulator: names, `reset` and `step`."""

    state_names = ("p_x", "p_y", "yaw", "v", "v_y", "yaw_rate")
    environment_names = ("grip [-]", "side force [kN]")
    environment_roles = ("friction", "side_force")
    dt = 2 * SUBSTEP
    wheelbase = Bicycle.LENGTH
    control_low = (-0.5, -6.0)
    control_high = (0.5, 3.0)

    def reset(self, state):
        """Put a car into a state."""
        self.car = Bicycle(None, state[:2], state[2], state[3])
        self.car.lateral_speed, self.car.yaw_rate = state[4:]

    def step(self, control, environment):
        """The state `dt` later; control = (steering [rad], acceleration [m/s²])."""
        grip, side_force = environment
        self.car.FRICTION_FRONT = self.car.FRICTION_REAR = FRICTION * grip
        self.car.side_acceleration = side_force / MASS
        self.car.act({"steering": control[0], "acceleration": control[1]})
        for _ in range(2):
            self.car.step(SUBSTEP)
        return self.car.state[:, 0]


def make():
    """What the option `vehicle.env=highway:make` names."""
    return Highway()
