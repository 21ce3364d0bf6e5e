"""A ROS 2 node around a trained controller: odometry in, drive commands out, at 10 Hz.

It subscribes to `odometry`, `path` and `road` (friction and side wind) and publishes
`drive`. It needs rclpy, nav_msgs, std_msgs and ackermann_msgs of a ROS 2 installation
beside this package.

    python controller_node.py --ros-args -p policy:=kinematic_path
"""

import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import rclpy
from ackermann_msgs.msg import AckermannDriveStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray

import sfkd_jax
from sfkd_jax.driving.paths import path_through, project, reference_window
from sfkd_jax.info import Reason

PARAMETERS = {
    "policy": "kinematic_path",  # the name of one that ships, or a run directory
    "speed": 10.0,  # wanted [m/s]
    "tolerance": 0.05,  # by which the path may be beside the poses, RMS [m]
    "timeout": 0.3,  # age at which an odometry message is too old [s]
    "patience": 5,  # control steps without usable inputs before braking
    "seed": 0,
}
BRAKING = -3.0  # [m/s²]
UNUSABLE = (Reason.BAD_REFERENCE, Reason.IMPRECISE)
"""Reasons against a claim for which the inputs are of no use. The others do not stop
the car: `healthy` is False at standstill, and a car must start from there.
"""


class ControllerNode(Node):
    """Holds the last messages; a timer plans from them.

    Odometry older than `timeout` becomes an observation of NaN: the controller then
    continues its last plan, and this node stops the car when that has lasted for
    `patience` steps. A message that cannot be used is refused with a line in the log,
    and the last one is kept.
    """

    def __init__(self) -> None:
        super().__init__("sfkd_controller")
        for name, value in PARAMETERS.items():
            self.declare_parameter(name, value)
        self.policy = sfkd_jax.load(self.setting("policy"))
        self.dt = self.policy.vehicle.dt
        self.horizon = self.policy.interface["horizon"]
        self.act = sfkd_jax.warm_up(self.policy)
        key = jax.random.key(self.setting("seed"))
        self.start = self.memory = self.policy.controller.init(key)

        self.odometry = None
        self.env = None
        self.path = None
        # Of the path, in the world [m]: maps need float64, and controllers float32.
        self.origin = np.zeros(2)
        self.seen = -math.inf  # when the last odometry message came [s]
        self.progress = jnp.zeros(())  # arc length along the path [m]
        self.blind = 0  # control steps since the inputs were usable
        self.steering = 0.0  # that was sent last [rad]

        self.create_subscription(Odometry, "odometry", self.on_odometry, 1)
        self.create_subscription(Path, "path", self.on_path, 1)
        self.create_subscription(Float32MultiArray, "road", self.on_road, 1)
        self.commands = self.create_publisher(AckermannDriveStamped, "drive", 1)
        self.create_timer(self.dt, self.plan)

    def setting(self, name: str):
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    @property
    def largest_curvature(self) -> float | None:
        """Largest curvature of the class of the policy at the speed [1/m]; or None."""
        certificate = self.policy.certificate
        if certificate is None or certificate.corridor is None:
            return None
        kind = certificate.corridor.conditions
        by_speed = kind.lateral_acceleration / self.setting("speed") ** 2
        return min(kind.peak_curvature, by_speed)

    def refuse(self, topic: str, reason: object) -> None:
        """Say why a message is not used. An exception would end the node."""
        self.get_logger().warning(f"{topic} refused, the last one is kept: {reason}")

    def on_odometry(self, message: Odometry) -> None:
        """Take position, yaw and forward speed.

        The further states of a dynamic model follow in its own order: side speed, yaw
        rate, and the steering angle. Odometry does not have the latter; it is near the
        one that was sent last.
        """
        pose = message.pose.pose
        twist = message.twist.twist
        q = pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        state = [
            pose.position.x,
            pose.position.y,
            yaw,
            twist.linear.x,
            twist.linear.y,
            twist.angular.z,
            self.steering,
        ]
        odometry = np.asarray(state[: len(self.policy.vehicle.state_names)])
        if not np.all(np.isfinite(odometry)):
            self.refuse("odometry", f"not finite, {odometry}")
            return
        self.odometry = odometry
        self.seen = time.monotonic()

    def on_path(self, message: Path) -> None:
        """Take a new path, which starts at its first point.

        Planners repeat poses, such as the goal: only one of them counts.
        """
        positions = [pose.pose.position for pose in message.poses]
        points = np.asarray([[position.x, position.y] for position in positions])
        points = points.reshape(-1, 2)
        points = points[np.any(np.diff(points, axis=0, prepend=np.nan) != 0.0, axis=1)]
        if len(points) < 2:
            self.refuse("path", f"it needs two different poses, got {len(points)}")
            return
        _, near, origin = sfkd_jax.relative(points[0], points)
        try:
            self.path = path_through(
                jnp.asarray(near),
                tolerance=self.setting("tolerance"),
                curvature=self.largest_curvature,
            )
        except ValueError as reason:
            self.refuse("path", reason)
            return
        self.origin = origin
        self.progress = jnp.zeros(())

    def on_road(self, message: Float32MultiArray) -> None:
        """Take friction [-] and lateral wind [m/s]."""
        env = np.asarray(message.data)
        size = len(self.policy.settings["space"]["env_mean"])
        if env.shape != (size,) or not np.all(np.isfinite(env)):
            self.refuse("road", f"{size} finite numbers are needed, got {env}")
            return
        self.env = jnp.asarray(env, dtype=float)

    def plan(self) -> None:
        """Take one control step."""
        if self.path is None or self.env is None or self.odometry is None:
            return
        fresh = time.monotonic() - self.seen < self.setting("timeout")
        # The origin is subtracted in float64: float32 resolves half a metre on a map.
        near = np.concatenate([self.odometry[:2] - self.origin, self.odometry[2:]])
        observation = jnp.asarray(near if fresh else np.full_like(near, np.nan))
        self.progress = self.progress + float(self.odometry[3]) * self.dt
        if fresh:
            # Where the odometry says that the car is, searched near the guess.
            self.progress, _ = project(self.path, observation[:2], self.progress)
        reference = reference_window(
            self.path,
            self.progress,
            jnp.asarray(self.setting("speed")),
            dt=self.dt,
            horizon=self.horizon,
        )
        if fresh and self.blind > self.setting("patience"):
            # It has not seen the braking, and begins anew.
            self.memory = self.start
        control, self.memory, info = self.act(
            self.policy.params, self.memory, observation, self.env, reference
        )
        reason = Reason(int(info.claim.reason))
        usable = fresh and reason not in UNUSABLE
        self.blind = 0 if usable else self.blind + 1
        if self.blind > self.setting("patience"):
            control = jnp.asarray([control[0], BRAKING])
        if self.blind == self.setting("patience") + 1:
            missing = reason.advice if fresh else "No odometry comes."
            self.get_logger().error(f"braking: {missing}")
        self.publish(control)

    def publish(self, control) -> None:
        """Send steering angle [rad] and acceleration [m/s²]."""
        self.steering = float(control[0])
        message = AckermannDriveStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.drive.steering_angle = self.steering
        message.drive.acceleration = float(control[1])
        self.commands.publish(message)


def main() -> None:
    """Spin until interrupted."""
    rclpy.init()
    node = ControllerNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
