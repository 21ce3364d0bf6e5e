"""A ROS 2 node around a trained controller: odometry in, drive commands out, at 10 Hz.

It subscribes to `odometry`, `path` and `road` (friction and side wind) and publishes
`drive`. It needs rclpy, nav_msgs, std_msgs and ackermann_msgs of a ROS 2 installation
beside this package.

    python controller_node.py --ros-args -p policy:=runs/s3/sfkd_path/seed=0
"""

import math
import time

import jax
import jax.numpy as jnp
import rclpy
from ackermann_msgs.msg import AckermannDriveStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray

import sfkd_jax
from sfkd_jax.driving.paths import path_through, project, reference_window

PARAMETERS = {
    "policy": "runs/s3/sfkd_path/seed=0",
    "speed": 10.0,  # wanted [m/s]
    "timeout": 0.3,  # age at which an odometry message is too old [s]
    "patience": 5,  # control steps without a healthy controller before braking
    "seed": 0,
}
BRAKING = -3.0  # [m/s²]


class ControllerNode(Node):
    """Holds the last messages; a timer plans from them.

    A message that is missing or older than `timeout` becomes an observation of NaN: the
    controller then continues its last plan and says so, and this node stops the car
    when that has lasted for `patience` steps.
    """

    def __init__(self) -> None:
        super().__init__("sfkd_controller")
        for name, value in PARAMETERS.items():
            self.declare_parameter(name, value)
        self.policy = sfkd_jax.load(self.setting("policy"))
        self.dt = self.policy.settings["vehicle"]["dt"]
        self.horizon = self.policy.settings["controller"]["mppi"]["horizon"]
        self.act = sfkd_jax.warm_up(self.policy)
        self.memory = self.policy.controller.init(jax.random.key(self.setting("seed")))

        self.odometry = None
        self.env = None
        self.path = None
        self.seen = -math.inf  # when the last odometry message came [s]
        self.progress = jnp.zeros(())  # arc length along the path [m]
        self.blind = 0  # control steps since the controller was healthy

        self.create_subscription(Odometry, "odometry", self.on_odometry, 1)
        self.create_subscription(Path, "path", self.on_path, 1)
        self.create_subscription(Float32MultiArray, "road", self.on_road, 1)
        self.commands = self.create_publisher(AckermannDriveStamped, "drive", 1)
        self.create_timer(self.dt, self.plan)

    def setting(self, name: str):
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    def on_odometry(self, message: Odometry) -> None:
        """Take position, yaw and forward speed.

        The further states of a dynamic model follow in its own order: side speed, yaw
        rate, and the steering angle, which odometry does not have.
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
            0.0,
        ]
        size = 3 + len(self.policy.settings["space"]["body_mean"])
        self.odometry = jnp.asarray(state[:size])
        self.seen = time.monotonic()

    def on_path(self, message: Path) -> None:
        """Take a new path, which starts at its first point."""
        positions = [pose.pose.position for pose in message.poses]
        points = [[position.x, position.y] for position in positions]
        self.path = path_through(jnp.asarray(points))
        self.progress = jnp.zeros(())

    def on_road(self, message: Float32MultiArray) -> None:
        """Take friction [-] and lateral wind [m/s]."""
        self.env = jnp.asarray(message.data)

    def plan(self) -> None:
        """Take one control step."""
        if self.path is None or self.env is None or self.odometry is None:
            return
        fresh = time.monotonic() - self.seen < self.setting("timeout")
        observation = self.odometry if fresh else jnp.full_like(self.odometry, jnp.nan)
        self.progress = self.progress + self.setting("speed") * self.dt
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
        control, self.memory, info = self.act(
            self.policy.params, self.memory, observation, self.env, reference
        )
        self.blind = 0 if bool(info.healthy) else self.blind + 1
        if self.blind > self.setting("patience"):
            control = jnp.asarray([control[0], BRAKING])
        self.publish(control)

    def publish(self, control) -> None:
        """Send steering angle [rad] and acceleration [m/s²]."""
        message = AckermannDriveStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.drive.steering_angle = float(control[0])
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
