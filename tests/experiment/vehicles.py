"""Step functions of vehicles of other sizes than a car, as a user would write them."""

from sfkd_jax.driving import plants

TRUCK = plants.dynamic(
    mass=40_000.0,
    yaw_inertia=1.2e6,
    front_length=4.0,
    rear_length=5.0,
    height=1.5,
    front_stiffness=2.2e6,
    rear_stiffness=2.6e6,
    steering_lag=0.2,
    wind_force=40.0,
)
"""A single track of 40 t and 20 m, with a wheelbase of 9 m."""
ROBOT = plants.kinematic(
    mass=60.0,
    front_length=0.25,
    rear_length=0.25,
    front_stiffness=3000.0,
    rear_stiffness=3000.0,
    wind_force=0.1,
    drag=0.01,
)
"""A delivery robot with a wheelbase of 0.5 m."""


def truck(state, control, env):
    return TRUCK.step(state, control, env)


def robot(state, control, env):
    return ROBOT.step(state, control, env)
