"""A ROS 2 node around a trained controller: odometry in, drive commands out, at 10 Hz.

ros2 run, or python controller_node.py --ros-args -p policy:=runs/s3/sfkd_path/seed=0
Needs rclpy, nav_msgs, std_msgs and ackermann_msgs of a ROS 2 installation beside this
package.
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
from sfkd_jax.scenarios import path_through, project, reference_window


class ControllerNode(Node):
    """Holds the last messages; a timer plans from them.

    A message that is missing or older than `timeout` becomes an observation of NaN: the
    controller then continues its last plan and says so, and this node stops the car
    when that has lasted for `patience` steps.
    """

    def __init__(self) -> None:
        super().__init__("sfkd_controller")
        defaults = {
            "policy": "runs/s3/sfkd_path/seed=0",
            "speed": 10.0,
            "timeout": 0.3,
            "patience": 5,
            "seed": 0,
        }
        for name, value in defaults.items():
            self.declare_parameter(name, value)
        self.policy = sfkd_jax.load(self.setting("policy"))
        self.dt = self.policy.settings["vehicle"]["dt"]
        self.horizon = self.policy.settings["controller"]["mppi"]["horizon"]
        self.act = sfkd_jax.warm_up(self.policy)
        self.memory = self.policy.controller.init(jax.random.key(self.setting("seed")))
        self.odometry = self.env = self.path = None
        self.seen, self.progress, self.blind = -math.inf, jnp.zeros(()), 0
        self.create_subscription(Odometry, "odometry", self.on_odometry, 1)
        self.create_subscription(Path, "path", self.on_path, 1)
        self.create_subscription(Float32MultiArray, "road", self.on_road, 1)
        self.commands = self.create_publisher(AckermannDriveStamped, "drive", 1)
        self.create_timer(self.dt, self.plan)

    def setting(self, name: str):
        """The value of a parameter."""
        return self.get_parameter(name).value

    def on_odometry(self, message: Odometry) -> None:
        """Position, yaw and forward speed; a dynamic model's further states follow in
        its own order.
        """
        pose, twist = message.pose.pose, message.twist.twist
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
        self.odometry, self.seen = jnp.asarray(state[:size]), time.monotonic()

    def on_path(self, message: Path) -> None:
        """A new path starts at its first point."""
        points = jnp.asarray(
            [[p.pose.position.x, p.pose.position.y] for p in message.poses]
        )
        self.path, self.progress = path_through(points), jnp.zeros(())

    def on_road(self, message: Float32MultiArray) -> None:
        """Friction [-] and lateral wind [m/s]."""
        self.env = jnp.asarray(message.data)

    def plan(self) -> None:
        """One control step."""
        if self.path is None or self.env is None or self.odometry is None:
            return
        fresh = time.monotonic() - self.seen < self.setting("timeout")
        observation = self.odometry if fresh else jnp.full_like(self.odometry, jnp.nan)
        guess = self.progress + self.setting("speed") * self.dt
        self.progress = (
            project(self.path, observation[:2], guess)[0] if fresh else guess
        )
        speed = jnp.asarray(self.setting("speed"))
        reference = reference_window(
            self.path, self.progress, speed, dt=self.dt, horizon=self.horizon
        )
        control, self.memory, info = self.act(
            self.policy.params, self.memory, observation, self.env, reference
        )
        self.blind = 0 if bool(info["healthy"]) else self.blind + 1
        self.publish(
            control
            if self.blind <= self.setting("patience")
            else jnp.asarray([control[0], -3.0])
        )

    def publish(self, control) -> None:
        """Steering angle and acceleration."""
        message = AckermannDriveStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.drive.steering_angle, message.drive.acceleration = (
            float(control[0]),
            float(control[1]),
        )
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
