"""The examples run, and do what they say."""

import runpy
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_the_pendulum_ends_upright(monkeypatch):
    assert example("mppi_own_dynamics", monkeypatch)["main"](samples=128) > 0.95


@pytest.mark.exhaustive
def test_the_pole_on_the_cart_ends_upright(monkeypatch, tmp_path):
    figure = tmp_path / "cartpole.png"
    assert example("cartpole", monkeypatch)["main"](samples=256, figure=figure) > 0.95
    assert figure.stat().st_size > 10_000


@pytest.mark.exhaustive
def test_the_quadrotor_passes_the_window(monkeypatch):
    distance, depth = example("quadrotor_window", monkeypatch)["main"](samples=512)
    assert distance < 0.3
    assert depth <= 1e-5


@pytest.mark.exhaustive
def test_a_fleet_arrives_and_touches_no_pillar(monkeypatch):
    left, gap = example("fleet", monkeypatch)["main"](count=16, samples=128)
    assert left < 0.5
    assert gap >= -1e-5


@pytest.mark.exhaustive
def test_a_lap_is_driven_within_the_track_and_the_grip(monkeypatch):
    sizes = {"samples": 192, "seconds": 29.0}
    lap, slip, depth = example("racing_line", monkeypatch)["main"](**sizes)
    assert lap < 29.0
    assert slip <= 1e-5
    assert depth <= 1e-5


@pytest.mark.exhaustive
def test_a_learned_residual_keeps_the_boat_off_the_rocks(monkeypatch):
    results = example("dubins_residual", monkeypatch)["main"](samples=256)
    (left, gap), (nominal_left, nominal_gap) = results["learned"], results["nominal"]
    assert left < nominal_left - 0.05
    assert gap > max(0.0, nominal_gap + 0.1)


@pytest.mark.exhaustive
def test_a_half_cheetah_runs(monkeypatch):
    assert example("half_cheetah", monkeypatch)["main"](samples=48, seconds=1.5) > 1.0


def test_the_delivery_robot_stays_on_its_path(monkeypatch):
    assert example("own_vehicle", monkeypatch)["main"](samples=96, seconds=6.0) < 0.05


@pytest.mark.exhaustive
def test_logged_runs_become_a_certified_model_that_plans(monkeypatch):
    result = example("own_data", monkeypatch)["main"](runs=60, steps=100)
    assert result["alpha"] < 1.0
    assert np.isfinite(result["position_error_m"])
    assert abs(result["first_control"]) <= 1.0


@pytest.mark.exhaustive
def test_the_brax_pendulum_is_learned_certified_and_driven(monkeypatch, capsys):
    """In two seconds a pole left alone lies. So short a training gives a certificate,
    not yet a good driver.
    """
    sizes = {"runs": 50, "steps": 50, "samples": 64, "horizon": 20, "seconds": 2.0}
    result = example("brax_pendulum", monkeypatch)["main"](**sizes)
    proof, rows = result["certificate"], result["rows"]
    assert proof["valid"]
    assert proof["attacks"]["step_slopes"] <= proof["alpha"] < 1.0
    assert len(proof["tube"]["latent"]) == 20
    assert np.isfinite(rows["SFKD"]["rms_m"])
    # e is 1 for the first three seconds.
    assert rows["SFKD"] == rows["SFKD, given e = 1"]
    assert not any(
        rows[way]["fallen"]
        for way in ("true dynamics", "true dynamics, no gain", "gain alone")
    )
    assert rows["true dynamics"]["rms_m"] < rows["gain alone"]["rms_m"]
    printed = capsys.readouterr().out
    assert all(f"{way} " in printed for way in rows)


# ---- ROS 2, against a stub of it -----------------------------------------------------------------------------------


class StubNode:
    """As much of rclpy.node.Node as the example uses."""

    def __init__(self, name):
        self.name, self.parameters, self.sent, self.timers = name, {}, [], []
        self.subscriptions_to = {}

    def declare_parameter(self, name, value):
        self.parameters[name] = value

    def get_parameter(self, name):
        return types.SimpleNamespace(value=self.parameters[name])

    def create_subscription(self, kind, topic, callback, depth):
        self.subscriptions_to[topic] = callback

    def create_publisher(self, kind, topic, depth):
        return types.SimpleNamespace(publish=self.sent.append)

    def create_timer(self, period, callback):
        self.timers.append((period, callback))

    def get_clock(self):
        return types.SimpleNamespace(
            now=lambda: types.SimpleNamespace(to_msg=lambda: 0)
        )


class Message(types.SimpleNamespace):
    """Any message: fields appear as they are used."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return getattr(self, name)


@pytest.fixture
def node(monkeypatch):
    """The example's node, with a tiny policy of random weights behind it."""
    import sfkd_jax
    from sfkd_jax import control, models, plants
    from sfkd_jax.policy import Policy

    modules = {
        "rclpy": {}, "rclpy.node": {"Node": StubNode}, "ackermann_msgs": {}, "nav_msgs": {}, "std_msgs": {},
        "ackermann_msgs.msg": {"AckermannDriveStamped": Message},
        "nav_msgs.msg": {"Odometry": Message, "Path": Message}, "std_msgs.msg": {"Float32MultiArray": Message},
    }  # fmt: skip
    for name, entries in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(entries)
        monkeypatch.setitem(sys.modules, name, module)
    plant = plants.kinematic()
    law, limits = control.path_feedback(wheelbase=plant.wheelbase), {}
    limits = {"control_low": plant.control_low, "control_high": plant.control_high}
    model = models.physics(plant.nominal)
    task = control.path_tracking(
        model, control.tracking_cost(dt=0.1), law, dt=0.1, **limits
    )
    controller = control.mppi(task, horizon=6, num_samples=16)
    settings = {
        "vehicle": {"dt": 0.1},
        "controller": {"mppi": {"horizon": 6}},
        "space": {"body_mean": [0.0]},
    }
    stored = {"law": None, "weights_sha256": "", "sha256": "", "certificate": None}
    policy = Policy(
        model=model,
        params={},
        vehicle=plant,
        settings=settings,
        controller=controller,
        **stored,
    )
    monkeypatch.setattr(sfkd_jax, "load", lambda path: policy)
    monkeypatch.setattr(
        sfkd_jax, "warm_up", lambda policy: jax.jit(policy.controller.act)
    )
    return runpy.run_path(str(EXAMPLES / "ros2" / "controller_node.py"))[
        "ControllerNode"
    ]()


def odometry(y=0.3):
    return Message(
        pose=Message(
            pose=Message(
                position=Message(x=0.0, y=y),
                orientation=Message(w=1.0, x=0.0, y=0.0, z=0.0),
            )
        ),
        twist=Message(
            twist=Message(linear=Message(x=10.0, y=0.0), angular=Message(z=0.0))
        ),
    )


def straight_path():
    return Message(
        poses=[
            Message(pose=Message(position=Message(x=float(k), y=0.0)))
            for k in range(60)
        ]
    )


def test_the_ros_node_waits_until_it_has_heard_everything_and_then_steers_to_the_path(
    node,
):
    ((period, tick),) = node.timers
    assert period == 0.1
    tick()
    assert node.sent == []
    node.on_path(straight_path())
    node.on_road(Message(data=[0.8, 0.0]))
    node.on_odometry(odometry())
    tick()
    assert len(node.sent) == 1
    assert node.sent[0].drive.steering_angle < 0  # the path lies to the right


def test_the_ros_node_brakes_when_it_has_not_seen_anything_for_a_while(node):
    node.on_path(straight_path())
    node.on_road(Message(data=[0.8, 0.0]))
    node.on_odometry(odometry())
    node.plan()
    node.seen -= 10.0
    for _ in range(node.setting("patience") + 1):
        node.plan()
    commands = [message.drive.acceleration for message in node.sent]
    assert commands[-1] == -3.0
    assert all(np.isfinite(commands))
    node.on_odometry(odometry())
    node.plan()
    assert node.sent[-1].drive.acceleration > -3.0
    assert float(jnp.asarray(node.progress)) < 20.0
