"""The examples run, and do what they say."""

import os
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sfkd_jax

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


QUICK = {
    # Height at the end, 1 is upright; RMS distance from the path [m].
    "mppi_own_dynamics": ({"samples": 128}, lambda upright: upright > 0.95),
    "own_vehicle": ({"samples": 96, "seconds": 6.0}, lambda error: error < 0.05),
}
LONG = {
    "cartpole": ({"samples": 256}, lambda upright: upright > 0.95),
    # Distance [m] from the window, depth [m] in its frame.
    "quadrotor_window": ({"samples": 512}, lambda end: end[0] < 0.3 and end[1] <= 1e-5),
    # Distance left [m], smallest gap [m].
    "fleet": (
        {"count": 16, "samples": 128},
        lambda end: end[0] < 0.5 and end[1] >= -1e-5,
    ),
    # Time of a lap [s], excess of grip, depth [m] beyond the track.
    "racing_line": (
        {"samples": 192, "seconds": 29.0},
        lambda lap: lap[0] < 29.0 and max(lap[1:]) <= 1e-5,
    ),
    "half_cheetah": ({"samples": 48, "seconds": 1.5}, lambda speed: speed > 1.0),
}


@pytest.mark.parametrize(
    "name",
    [*QUICK, *(pytest.param(name, marks=pytest.mark.exhaustive) for name in LONG)],
)
def test_an_example_reaches_its_goal(name, monkeypatch):
    sizes, reached = (QUICK | LONG)[name]
    assert reached(example(name, monkeypatch)["main"](**sizes))


@pytest.mark.exhaustive
def test_the_car_in_its_lane_passes_every_obstacle(monkeypatch, tmp_path):
    film = tmp_path / "lane.gif"
    result = example("lane", monkeypatch)["main"](runs=1, film=film)
    assert result["collisions"] == result["clearance_below_claim"] == 0
    assert result["worst_lateral_m"] < result["corridor_m"]
    assert film.exists()


@pytest.mark.exhaustive
def test_a_learned_residual_keeps_the_boat_off_the_rocks(monkeypatch):
    results = example("dubins_residual", monkeypatch)["main"](samples=256)
    left, gap = results["learned"]
    nominal_left, nominal_gap = results["nominal"]
    assert left < nominal_left - 0.05
    assert gap > max(0.0, nominal_gap + 0.1)


@pytest.mark.exhaustive
def test_logged_runs_become_a_certified_model_that_plans(monkeypatch):
    result = example("own_data", monkeypatch)["main"](runs=60, steps=100)
    assert result["alpha"] < 1.0
    assert np.isfinite(result["position_error_m"])
    assert abs(result["first_control"]) <= 1.0


# ---- ROS 2, against a stub of it


class StubNode:
    """As much of rclpy.node.Node as the example uses."""

    def __init__(self, name):
        self.name = name
        self.parameters = {}
        self.sent = []
        self.log = []
        self.timers = []
        self.create_subscription = lambda message, topic, callback, depth: callback
        stamp = SimpleNamespace(to_msg=lambda: 0)
        self.get_clock = lambda: SimpleNamespace(now=lambda: stamp)
        logger = SimpleNamespace(warning=self.log.append, error=self.log.append)
        self.get_logger = lambda: logger

    def declare_parameter(self, name, value):
        self.parameters[name] = value

    def get_parameter(self, name):
        return SimpleNamespace(value=self.parameters[name])

    def create_publisher(self, message, topic, depth):
        return SimpleNamespace(publish=self.sent.append)

    def create_timer(self, period, callback):
        self.timers.append((period, callback))


class Message(SimpleNamespace):
    """Any message: fields appear as they are used."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return getattr(self, name)


DEFAULT = "kinematic_path"
"""The policy that the node takes unless it is told another one."""


@cache
def shipped(name):
    """A policy that ships, compiled once; those in the world with fewer samples."""
    policy = sfkd_jax.load(name)
    if name in ("kinematic", "dynamic"):
        chosen = dict(policy.settings["controller"])
        chosen["mppi"] = {**chosen["mppi"], "num_samples": 100}
        policy = sfkd_jax.load(name, controller=chosen)
    return policy, sfkd_jax.warm_up(policy)


@pytest.fixture
def make_node(monkeypatch):
    """(name of a policy) -> the example's node."""
    modules = {"rclpy": {}, "rclpy.node": {"Node": StubNode}}
    for name, entry in (
        ("ackermann_msgs", "AckermannDriveStamped"),
        ("nav_msgs", "Odometry"),
        ("std_msgs", "Float32MultiArray"),
    ):
        modules |= {name: {}, f"{name}.msg": {entry: Message, "Path": Message}}
    for name, entries in modules.items():
        module = ModuleType(name)
        module.__dict__.update(entries)
        monkeypatch.setitem(sys.modules, name, module)
    source = runpy.run_path(str(EXAMPLES / "ros2" / "controller_node.py"))

    def make(name):
        policy, act = shipped(name)
        monkeypatch.setattr(sfkd_jax, "load", {name: policy}.__getitem__)
        monkeypatch.setattr(sfkd_jax, "warm_up", lambda _: act)
        source["PARAMETERS"]["policy"] = name
        return source["ControllerNode"]()

    assert source["PARAMETERS"]["policy"] == DEFAULT
    return make


@pytest.fixture
def node(make_node):
    """The example's node as it is."""
    return make_node(DEFAULT)


def odometry_of(state):
    """A message with the first states of a car; further ones than four may follow."""
    x, y, yaw, v, side, turning = map(float, [*state, 0.0, 0.0][:6])
    odometry = Message()
    turn = Message(w=np.cos(yaw / 2), x=0.0, y=0.0, z=np.sin(yaw / 2))
    odometry.pose.pose = Message(position=Message(x=x, y=y), orientation=turn)
    twist = Message(linear=Message(x=v, y=side), angular=Message(z=turning))
    odometry.twist.twist = twist
    return odometry


def path_of(points):
    places = (Message(x=float(x), y=float(y)) for x, y in points)
    return Message(poses=[Message(pose=Message(position=place)) for place in places])


def drive(node, state, steps, *, origin=(0.0, 0.0)):
    """Drive the car that the policy was trained on, a tick of the node a step."""
    step = jax.jit(node.policy.vehicle.step)
    offset = np.zeros(len(state))
    offset[:2] = origin
    for _ in range(steps):
        node.on_odometry(odometry_of(state + offset))
        node.plan()
        sent = node.sent[-1].drive
        control = jnp.asarray([sent.steering_angle, sent.acceleration])
        state = np.asarray(step(jnp.asarray(state), control, node.env), dtype=float)
    return state


def ready(node, *, origin=(0.0, 0.0)):
    """Give the node a straight path of 100 m and a road."""
    node.on_path(path_of([origin, np.add(origin, (100.0, 0.0))]))
    node.on_road(Message(data=[0.8, 0.0]))


def test_the_ros_node_waits_for_everything_steers_to_the_path_and_brakes_when_blind(
    node,
):
    ((period, tick),) = node.timers
    assert period == 0.1
    tick()
    assert node.sent == []
    ready(node)
    odometry = odometry_of([0.0, 0.3, 0.0, 10.0])
    node.on_odometry(odometry)
    tick()
    assert len(node.sent) == 1
    assert node.sent[0].drive.steering_angle < 0  # the path lies to the right
    node.seen -= 10.0
    for _ in range(node.setting("patience") + 1):
        node.plan()
    commands = [message.drive.acceleration for message in node.sent]
    assert commands[-1] == -3.0
    assert all(np.isfinite(commands))
    assert node.log == ["braking: No odometry comes."]
    node.on_odometry(odometry)
    node.plan()
    assert node.sent[-1].drive.acceleration > -3.0
    assert float(node.progress) < 20.0


def test_the_ros_node_starts_from_standstill_and_again_after_a_gap(node):
    ready(node)
    state = drive(node, np.zeros(4), 30)
    assert state[3] > 3.0
    node.seen -= 10.0
    for _ in range(20):
        node.plan()
    assert node.sent[-1].drive.acceleration == -3.0
    # It stands where the brake left it.
    state[3] = 0.0
    assert drive(node, state, 30)[3] > 3.0


@pytest.mark.parametrize("name", sfkd_jax.policies())
def test_the_ros_node_drives_with_every_policy_that_ships(make_node, name):
    """From rest, round a bend of 60 m radius, on poses with centimetres of noise."""
    node = make_node(name)
    node.parameters["speed"] = 5.0
    angles = np.arange(0.0, 1.5, 0.5 / 60.0)
    bend = 60.0 * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])
    bend += 0.02 * np.random.default_rng(0).standard_normal(bend.shape)
    node.on_path(path_of(bend))
    node.on_road(Message(data=[0.8, 0.0]))
    state = drive(node, np.zeros(len(node.policy.vehicle.states)), 60)
    assert node.log == []
    assert state[3] > 4.0
    assert np.hypot(state[0], state[1] - 60.0) == pytest.approx(60.0, abs=0.3)
    assert state[0] > 10.0


def test_the_ros_node_follows_a_path_in_coordinates_of_a_map(node):
    origin = (5e5, 4.5e6)
    ready(node, origin=origin)
    state = drive(node, np.array([0.0, 0.5, 0.0, 8.0]), 30, origin=origin)
    assert abs(state[1]) < 0.3
    assert state[3] > 8.0
    assert node.log == []


LINE = [(0.0, 0.0), (9.0, 0.0)]


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("path", path_of([])),
        ("path", path_of(LINE[:1])),
        ("path", path_of([LINE[0], LINE[0]])),
        ("path", path_of([*LINE, (9.0, 9.0)])),
        ("path", path_of([LINE[0], (np.nan, 0.0)])),
        ("path", path_of([LINE[0], (0.1, 0.0)])),
        ("road", Message(data=[0.8])),
        ("road", Message(data=[0.8, 0.0, 0.0])),
        ("road", Message(data=[np.nan, 0.0])),
        ("odometry", odometry_of([np.nan, 0.0, 0.0, 5.0])),
    ],
)
def test_the_ros_node_refuses_a_message_in_a_line_and_keeps_the_last(
    node, topic, message
):
    ready(node)
    node.on_odometry(odometry_of([0.0, 0.0, 0.0, 5.0]))
    before = (node.path, node.env, node.odometry, node.seen)
    getattr(node, f"on_{topic}")(message)
    after = (node.path, node.env, node.odometry, node.seen)
    assert all(new is old for new, old in zip(after, before, strict=True))
    (line,) = node.log
    assert line.startswith(f"{topic} refused")
    assert "\n" not in line


def test_the_ros_node_takes_poses_that_are_there_twice(node):
    node.on_path(path_of([LINE[0], *LINE, LINE[1]]))
    assert node.log == []
    np.testing.assert_allclose(node.path.points[-1], [9.0, 0.0, 0.0, 0.0], atol=1e-5)


def test_samples_and_vehicles_spread_over_four_devices_give_the_same_controls():
    script = """if True:
        import numpy as np
        from devices import main
        from sfkd_jax.control.planners import _rollouts
        car, spread, fleet, spread_fleet = main(samples=256, vehicles=8).values()
        for (u, alone, _), (v, shared, _) in ((car, spread), (fleet, spread_fleet)):
            np.testing.assert_allclose(u, v, atol=1e-5)
            work = [p.cost_analysis()["flops"] for p in (alone, shared)]
            assert 0.24 < work[1] / work[0] < 0.27, work
            # Only sums over samples travel, never the samples.
            assert "all-gather" not in shared.as_text()
        assert ["all-reduce" in p[1].as_text() for p in (spread, spread_fleet)] == [1, 0]
        _rollouts.LARGEST_BATCH = 4_000  # batches of 64 samples, of every device
        for u, v in zip((car, spread), main(samples=256, vehicles=8).values()):
            np.testing.assert_allclose(u[0], v[0], atol=1e-5)
            assert "all-gather" not in v[1].as_text()
    """
    four = "--xla_force_host_platform_device_count=4"
    flags = {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {four}"}
    command = [sys.executable, "-c", script]
    subprocess.run(command, check=True, cwd=EXAMPLES, env=os.environ | flags)


def test_what_an_accelerator_is_measured_with_runs_without_one(tmp_path):
    script = EXAMPLES.parent / "benchmarks" / "gpu.sh"
    subprocess.run(["bash", script, "--small", f"root={tmp_path}", "speed"], check=True)
    assert '"compilations": 1' in (tmp_path / "device.json").read_text()
