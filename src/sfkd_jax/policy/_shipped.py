"""The policies that ship with the package, by name."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from sfkd_jax.certificate import read
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.policy._files import CERTIFICATE, POLICY_FILE

SHIPPED = Path(__file__).parents[1] / "pretrained"
"""A folder for each shipped policy, as `train` wrote it."""


class ShippedPolicy(NamedTuple):
    """What a shipped policy drives, read from its certificate.

    `sfkd_jax.load` verifies the certificate; this summary does not.

    Attributes:
        vehicle: name of the simulated vehicle.
        frame: "path" for path coordinates, "body" for the frame of the body, in which
            nothing is known about the distance from a path.
        corridor_m: half width of the calibrated corridor [m].
        speed: lowest and highest speed of the class [m/s].
        peak_curvature: largest curvature of the roads of the class [1/m].
        env_low: lowest friction [-] and side wind [m/s].
        env_high: highest friction [-] and side wind [m/s].
    """

    vehicle: str
    frame: str
    corridor_m: float | None
    speed: tuple[float, float] | None
    peak_curvature: float | None
    env_low: tuple[float, ...]
    env_high: tuple[float, ...]


def policies() -> dict[str, ShippedPolicy]:
    """Return the policies that ship, by the names that `load` takes."""
    return {name: _summary(SHIPPED / name) for name in shipped_names()}


def shipped_names() -> list[str]:
    """Return the names of the policies that ship with the package."""
    return sorted(file.parent.name for file in SHIPPED.glob(f"*/{POLICY_FILE}"))


def _summary(folder: Path) -> ShippedPolicy:
    """Read the summary of one policy from its certificate."""
    certificate = read(folder / CERTIFICATE, DrivingCertificate)
    assert isinstance(certificate, DrivingCertificate)
    env_low, env_high = certificate.measured.boxes.env
    corridor = certificate.corridor
    return ShippedPolicy(
        vehicle=folder.name.split("_")[0],
        frame="path" if corridor else "body",
        corridor_m=corridor.corridor_m if corridor else None,
        speed=corridor.conditions.speed if corridor else None,
        peak_curvature=corridor.conditions.peak_curvature if corridor else None,
        env_low=tuple(round(end, 6) for end in env_low),
        env_high=tuple(round(end, 6) for end in env_high),
    )
