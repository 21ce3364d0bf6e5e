"""A car that drives with a shipped policy in its lane, live in a browser."""

from sfkd_jax.viewer._live_drive import LiveDrive as LiveDrive
from sfkd_jax.viewer._live_drive import LiveState as LiveState
from sfkd_jax.viewer._live_drive import Moment as Moment
from sfkd_jax.viewer._live_drive import UserInput as UserInput
from sfkd_jax.viewer._live_drive import live_drive as live_drive
from sfkd_jax.viewer._panel import Panel as Panel
from sfkd_jax.viewer._server import served as served
from sfkd_jax.viewer._server import show as show
