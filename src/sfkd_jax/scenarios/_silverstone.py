"""The centre line of Silverstone, as a path with a pace that its bends allow.

Source: https://github.com/bacinger/f1-circuits, circuits/gb-1948.geojson.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.scenarios._paths import SPACING, Path, blended_in, path_from_curvature
from sfkd_jax.types import Key

LENGTH = 5891.0
"""Of a lap, as published [m]."""
SMOOTHING = 10.0
"""Standard deviation of the Gaussian that rounds the corners of the polygon [m]."""
PEAK_CURVATURE = 0.02
"""Up to which a bend is driven at full speed, as on the random roads [1/m]."""
BRAKING, ACCELERATING = 0.05, 0.016
"""Largest slopes of the squared pace [1/m]: 2.5 and 0.8 m/s² at 10 m/s."""
# The positions are from the file above, under this notice:
#
# Copyright (c) 2019-2022 Tomislav Bacinger
#
# Permission is hereby granted, free of charge, to any person obtaining a copy of this
# software and associated documentation files (the "Software"), to deal in the Software
# without restriction, including without limitation the rights to use, copy, modify,
# merge, publish, distribute, sublicense, and/or sell copies of the Software, and to
# permit persons to whom the Software is furnished to do so, subject to the following
# conditions:
#
# The above copyright notice and this permission notice shall be included in all copies
# or substantial portions of the Software.
#
# THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED,
# INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A
# PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT
# HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF
# CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE
# OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
# fmt: off
CENTRE_LINE = (
    (116.1, 867.3), (300.3, 883.0), (333.6, 881.0), (359.2, 872.6), (375.8, 861.6),
    (395.7, 838.5), (408.3, 812.3), (418.4, 779.2), (432.7, 723.1), (447.3, 668.1),
    (455.8, 607.2), (459.4, 568.9), (464.3, 476.1), (466.3, 396.9), (469.6, 366.0),
    (481.4, 337.0), (503.6, 296.6), (513.0, 273.6), (512.6, 256.3), (508.5, 235.9),
    (476.9, 152.4), (474.8, 118.8), (479.7, 94.8), (491.1, 74.3), (522.4, 30.8),
    (529.6, 10.8), (530.5, -12.8), (525.2, -34.3), (506.1, -57.9), (481.8, -75.2),
    (448.4, -94.6), (422.5, -109.8), (404.2, -127.6), (383.2, -162.8), (341.7, -240.3),
    (114.0, -658.4), (39.4, -774.3), (18.2, -802.7), (1.2, -817.8), (-18.7, -827.8),
    (-39.4, -833.1), (-58.4, -831.5), (-79.5, -826.7), (-97.4, -818.9),
    (-113.2, -806.4), (-126.6, -786.3), (-130.7, -778.5), (-151.0, -734.5),
    (-173.7, -695.1), (-198.0, -662.6), (-214.7, -642.7), (-233.3, -622.2),
    (-266.3, -588.6), (-339.7, -501.0), (-347.0, -496.4), (-357.2, -495.3),
    (-367.3, -500.0), (-398.1, -527.9), (-408.7, -531.5), (-419.2, -530.4),
    (-428.1, -526.7), (-440.8, -514.7), (-454.1, -501.0), (-470.8, -479.0),
    (-482.9, -455.4), (-491.5, -431.3), (-498.8, -404.0), (-499.6, -393.0),
    (-497.5, -382.0), (-491.5, -371.5), (-476.9, -348.4), (-252.8, -56.9),
    (-202.5, 7.7), (-192.0, 19.8), (-173.7, 31.8), (-151.8, 37.1), (-133.9, 37.6),
    (-109.2, 35.5), (-40.2, 25.0), (-17.4, 22.4), (6.1, 21.4), (32.9, 25.0),
    (57.3, 31.3), (79.1, 43.4), (222.0, 156.7), (231.4, 162.9), (242.7, 168.7),
    (254.5, 169.8), (263.4, 166.6), (271.5, 159.2), (276.4, 150.9), (300.7, 65.9),
    (308.1, 53.9), (318.2, 46.5), (330.0, 46.0), (343.0, 51.7), (351.1, 62.2),
    (356.4, 73.2), (366.5, 101.0), (374.6, 124.6), (380.7, 147.8), (383.9, 170.2),
    (386.0, 193.9), (384.3, 218.5), (379.5, 229.5), (366.9, 243.7), (-96.2, 665.4),
    (-108.8, 673.3), (-126.2, 682.2), (-147.7, 685.3), (-170.1, 682.7), (-192.7, 671.7),
    (-200.9, 661.7), (-206.6, 647.0), (-215.9, 570.5), (-221.2, 554.8), (-232.5, 542.1),
    (-249.6, 533.8), (-268.2, 531.1), (-289.0, 536.4), (-303.6, 546.3), (-312.5, 557.9),
    (-319.4, 571.5), (-320.6, 586.2), (-317.8, 602.0), (-306.4, 627.7), (-246.8, 745.6),
    (-227.7, 768.2), (-209.0, 787.1), (-182.2, 810.1), (-160.3, 825.4), (-132.7, 837.0),
    (-108.8, 844.8), (-58.0, 851.1), (113.2, 866.8),
)
# fmt: on
"""Metres east and north of 52.071 N, 1.017 W, clockwise from the start."""


def lap(key: Key, length: float) -> Path:
    """Return so much of the circuit from a random place on, at its pace.

    An episode starts where the pace is 1; the curvature is blended in.

    Args:
        key: consumed.
        length: smallest length [m]; after a lap the next one begins.
    """
    curvature = circuit_curvature()
    pace = pace_of(curvature)
    count = curvature.shape[0]
    fast = (pace == 1.0) / jnp.sum(pace == 1.0)
    along = jnp.arange(int(length / SPACING) + 2)
    index = (jax.random.choice(key, count, p=fast) + along) % count
    road = blended_in(curvature[index], along * SPACING)
    return path_from_curvature(road, spacing=SPACING)._replace(pace=pace[index])


def circuit_curvature() -> Float[Array, " point"]:
    """Return the curvature of a lap at equal distances of `SPACING` [1/m].

    The polygon is a closed curve z(s) in the complex plane. A Gaussian rounds it, and
    the derivatives in κ = Im(z'* z'') / |z'|³ are exact for its Fourier series.
    """
    corners = jnp.asarray(CENTRE_LINE)
    corners = jnp.concatenate([corners, corners[:1]])
    steps = jnp.linalg.norm(jnp.diff(corners, axis=0), axis=1)
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    count = round(LENGTH / SPACING)
    s = jnp.arange(count) * along[-1] / count
    x, y = (jnp.interp(s, along, corners[:, axis]) for axis in (0, 1))
    wave = 2.0 * jnp.pi * jnp.fft.fftfreq(count, along[-1] / count)
    smooth = jnp.fft.fft(x + 1j * y) * jnp.exp(-0.5 * (wave * SMOOTHING) ** 2)
    first = jnp.fft.ifft(1j * wave * smooth)
    second = jnp.fft.ifft(-(wave**2) * smooth)
    rate = jnp.abs(first)
    curvature = jnp.imag(jnp.conj(first) * second) / rate**3
    # Rounding has shortened the lap: equal distances along the smooth curve, which is
    # then scaled to the published length.
    driven = jnp.cumsum(rate) - rate[0]
    total = jnp.sum(rate)
    equal = jnp.arange(count) * total / count
    scale = total * along[-1] / count / LENGTH
    return jnp.interp(equal, driven, curvature, period=total) * scale


def pace_of(curvature: Float[Array, " point"]) -> Float[Array, " point"]:
    """Return the largest share of the speed that lateral and longitudinal limits allow.

    The squared pace is at most κ_max / |κ|, falls by at most `BRAKING` and rises by at
    most `ACCELERATING` a metre.
    """
    limit = jnp.minimum(1.0, PEAK_CURVATURE / jnp.maximum(jnp.abs(curvature), 1e-6))

    def lowered(limit: Float[Array, " point"], slope: float) -> Float[Array, " point"]:
        def advance(before: Array, here: Array) -> tuple[Array, Array]:
            allowed = jnp.minimum(here, before + slope * SPACING)
            return allowed, allowed

        # The lap before ends where this one begins.
        last, _ = jax.lax.scan(advance, jnp.ones(()), limit)
        return jax.lax.scan(advance, last, limit)[1]

    limit = lowered(limit, ACCELERATING)
    return jnp.sqrt(lowered(limit[::-1], BRAKING)[::-1])
