"""What the shipped path policies do outside their box: far away, deceived, braking.

    python -m benchmarks.recovery [--runs 16 --samples 64 --rows starts faults]

The cars are the true ones, and their sensors fail in named ways. Every run is a row of
arrays (`Runs`), so that each of three controllers compiles once: the policy, a request
inside the gate and shield of the policy, and the same request without them. The
results go to benchmarks/recovery.json, one line a row.
"""

import time
from collections import namedtuple
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from benchmarks import arguments, device, stamp, write
from benchmarks.device import CARS, HORIZON, PERIOD
from sfkd_jax import geometry
from sfkd_jax.driving import path_following, plants, scenarios
from sfkd_jax.driving.path_coordinates import LATERAL
from sfkd_jax.driving.paths import (
    Path,
    path_from_curvature,
    point_at,
    project,
    reference_window,
)
from sfkd_jax.driving.simulation.metrics import room_in_lane
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.info import ControllerInfo, PlanInfo
from sfkd_jax.schedules import random_switching
from sfkd_jax.types import Controller

SPACING = 0.5
"""Between points of a path [m]."""
TICK = 0.02
"""Step of the simulated cars [s]."""
TICKS = 5
"""Of them between two calls of the controller."""
PART = 50
"""Calls of a compiled part of a run."""
PAST = 51
"""Readings that are kept for a sensor that is late."""
NEAR = 100
"""Points of the path that are searched to each side of the last foot."""
LONGEST = 600
"""Calls of the longest runs."""
POINTS = 1752
"""Of the roads of the longest runs, which last a quarter longer at 10 m/s."""
DEPARTED = 2.0
"""Distance from the path that counts as a departure [m]."""
BACK = 0.3
"""Distance [m] and heading error [rad] below which a car is back."""
KINDS = (
    "law",  # the law + ν
    "worst",  # ν at its limit, outwards
    "brake",  # the hardest braking
    "linear",  # the law of the box, without recovery
    "NaN",  # not a number
    "lock",  # full lock
)
"""Of requests."""
REAL = np.float32
WHOLE = np.int32
CALL = {
    "env": ((2,), REAL),  # that the car is in
    "told": ((2,), REAL),  # that the controller is told
    "speed": ((), REAL),  # v_ref [m/s]
    "aside": ((), REAL),  # the reference, moved to the left [m]
    "steering": ((), REAL),  # added to the steering angle [rad]
    "offset": ((3,), REAL),  # of the measured pose: ahead, to the left [m], yaw [rad]
    "body": (None, REAL),  # of the measured body state, which differs between cars
    "lag": ((), WHOLE),  # calls since the reading that the sensor shows
    "lost": ((), bool),  # whether it shows NaN
    "kind": ((), WHOLE),  # of the request, index of `KINDS`
    "nu": ((2,), REAL),  # as a share of its limit
}
"""What a run meets at every call: shape and type; arrays begin (run, time)."""
Now = namedtuple("Now", CALL)
Runs = namedtuple("Runs", "start foot road seed now")
"""Runs of one length; arrays begin with the run: state and arc length [m] at the start,
points of the path, seed of noise and samples, and what every call meets.
"""


def request(law, low, high, now):
    """A planner along a path that asks for one kind, whatever is measured."""
    low = jnp.asarray(low)
    high = jnp.asarray(high)

    def act(params, memory, xi, env, preview):
        curvature, speed = preview.road[0]
        lawful = law(xi, curvature, speed, env)
        turn = law.turn(curvature, speed, env)
        outwards = jnp.stack([jnp.where(xi[LATERAL] < 0.0, -1.0, 1.0), 1.0])
        asked = (
            lawful + now.nu * law.perturbation,
            lawful + outwards * law.perturbation,
            lawful.at[1].set(low[1]),
            turn.control - turn.gain @ (xi - turn.state),
            jnp.full(2, jnp.nan),
            jnp.where(now.nu > 0.0, high, low),
        )
        plan = PlanInfo(
            effective_samples=jnp.ones(()), states=jnp.tile(xi, (HORIZON, 1))
        )
        info = ControllerInfo(plan=plan)
        return jnp.clip(jnp.stack(asked)[now.kind], low, high), memory, info

    return Controller(lambda key: (), act)


class Car:
    """A shipped policy, its true car, and three programs that drive it."""

    def __init__(self, name, samples, batch):
        self.loaded = device.loaded(name, samples)
        self.name = name
        self.batch = batch
        self.step = getattr(plants, name)(dt=TICK, substeps=1).step
        self.corridor = self.loaded.certificate.corridor.corridor_m
        self.states = len(self.loaded.vehicle.state_names)
        self.noise = np.asarray(self.loaded.vehicle.sensor_noise, np.float32)
        self.room = room_in_lane(self.loaded.vehicle.size)
        # The loaded controller needs no request.
        self.policy = self.program(lambda _: self.loaded.controller)
        self.guarded = self.program(partial(self.asking, guard=True))
        self.bare = self.program(partial(self.asking, guard=False))

    def asking(self, now, *, guard):
        """A request of `KINDS` in the world, inside the policy's shield or without it."""
        plant = self.loaded.vehicle
        law = self.loaded.law
        planner = request(law, plant.control_low, plant.control_high, now)
        if guard:
            # The shield is made of numbers, also while a program is traced.
            with jax.ensure_compile_time_eval():
                return self.loaded.shield(planner, along_path=True)
        return path_following.along_reference(planner, coordinates=law.gain.shape[-1])

    def program(self, make):
        """(runs) -> what is recorded of every call, (run, time, …)."""
        part = jax.jit(jax.vmap(partial(part_of_run, self, make)))
        begin = jax.jit(jax.vmap(lambda seed: make(None).init(jax.random.key(seed))))

        def batch(runs, rows):
            runs = jax.tree.map(lambda leaf: leaf[rows], runs)
            runs = jax.device_put(runs._replace(now=None))._replace(now=runs.now)
            past = np.repeat(runs.start[:, None], PAST, axis=1)
            number = np.zeros(len(rows), np.int32)
            carry = (number, runs.start, runs.foot, begin(runs.seed), past)
            steps = runs.now.lost.shape[1]
            parts = []
            for first in range(0, steps, PART):
                calls = np.minimum(first + np.arange(PART), steps - 1)
                now = jax.tree.map(lambda leaf, calls=calls: leaf[:, calls], runs.now)
                carry, recorded = part(runs._replace(now=now), carry)
                parts.append(jax.tree.map(np.asarray, recorded))
            return jax.tree.map(
                lambda *all_parts: np.concatenate(all_parts, 1)[:, :steps], *parts
            )

        def drive(runs):
            # Batches and parts of one size: every call is the compiled program.
            count = len(runs.seed)
            each = np.arange(self.batch)
            batches = [
                batch(runs, np.minimum(first + each, count - 1))
                for first in range(0, count, self.batch)
            ]
            return jax.tree.map(
                lambda *all_batches: np.concatenate(all_batches)[:count], *batches
            )

        return drive


def foot_of(path, position, before):
    """Arc length and distance of the nearest point of the path near the last foot."""
    last = path.points.shape[0] - 2 * NEAR
    first = jnp.clip((before / SPACING).astype(int) - NEAR, 0, last)
    near = jax.lax.dynamic_slice_in_dim(path.points, first, 2 * NEAR)
    best = jnp.argmin(jnp.sum((near[:, :2] - position) ** 2, axis=1))
    return project(path, position, SPACING * (first + best))


def part_of_run(car, make, runs, carry):
    """`PART` calls of one run, whose arrays have lost their first axis."""
    path = Path(runs.road, jnp.asarray(SPACING))
    key = jax.random.key(runs.seed + 1)

    def step(carry, now):
        number, state, foot, memory, past = carry
        foot, left = foot_of(path, state[:2], foot)
        yaw = point_at(path, foot)[2]
        ahead = reference_window(path, foot, now.speed, dt=PERIOD, horizon=HORIZON)
        normals = jnp.stack([-jnp.sin(ahead[:, 2]), jnp.cos(ahead[:, 2])], axis=1)
        ahead = ahead.at[:, :2].add(now.aside * normals)
        fresh = jax.random.normal(jax.random.fold_in(key, number), state.shape)
        past = jnp.concatenate([(state + car.noise * fresh)[None], past[:-1]])
        shift = geometry.rotate(yaw, now.offset[:2])
        seen = past[now.lag] + jnp.concatenate([shift, now.offset[2:], now.body])
        seen = jnp.where(now.lost, jnp.nan, seen)
        acted, memory, info = make(now).act(
            car.loaded.params, memory, seen, now.told, ahead
        )
        turned = acted.at[0].add(now.steering)
        after = jax.lax.fori_loop(
            0, TICKS, lambda _, x: car.step(x, turned, now.env), state
        )
        recorded = {
            "left": left - now.aside,
            "turned": wrap_angle(state[2] - yaw),
            "along": foot,
            "state": state,
            "healthy": info.healthy,
        }
        if info.shield is not None:
            recorded["healthy"] &= info.claim.holds
            recorded["bound"] = info.claim.bound
            recorded["alarm"] = info.gate.alarm
        return (number + 1, after, foot, memory, past), recorded

    return jax.lax.scan(step, carry, runs.now)


def roads(count, seed, conditions=None, bends=None):
    """Points of paths, (run, point, 4), and schedules of e, (run, 600, 2).

    They are S3's own, but for schedules by `conditions`, (key) -> (600, 2), and for paths
    whose curvature is `bends` [1/m].
    """
    family = scenarios.scenario(
        name="s3", duration=1.25 * LONGEST * PERIOD, state_size=4, dt=PERIOD
    )
    keys = jax.random.split(jax.random.key(seed), count)
    scenes = jax.jit(jax.vmap(family))(keys)
    points = np.asarray(scenes.path.points)
    envs = np.asarray(scenes.envs)
    if conditions is not None:
        envs = np.asarray(jax.jit(jax.vmap(conditions))(keys))
    if bends is not None:
        bent = partial(path_from_curvature, spacing=SPACING)
        turns = bends * np.ones(points.shape[:2])
        points = np.asarray(jax.jit(jax.vmap(lambda one: bent(one).points))(turns))
    return points, envs


def runs_on(car, road, steps, seed, *, foot=0.0, beside=(), **now):
    """Runs on roads.

    Args:
        car: that drives.
        road: points of paths and schedules of e, from `roads`.
        steps: calls of a run.
        seed: of noise and samples.
        foot: arc length at the start [m].
        beside: distance to the left [m], heading error [rad], speed [m/s] and body state
            at the start; entries that are left out are those of a car on its path.
        now: fields of `Now`, (run, time, …) or what broadcasts to it. What is left out is
            0, but the reference speed is 10 m/s, e is that of the road, and the controller
            is told e as it is.
    """
    points, envs = road
    count = len(points)
    # Beyond the schedule the last value of e stays.
    schedule = envs[:, np.minimum(range(steps), LONGEST - 1)]
    fields = {"speed": 10.0, "env": schedule} | now
    fields = {"told": fields["env"]} | fields
    filled = Now(
        *(
            np.broadcast_to(
                np.asarray(fields.get(name, 0), kind),
                (count, steps, *((car.states - 3,) if shape is None else shape)),
            )
            for name, (shape, kind) in CALL.items()
        )
    )
    foot = np.asarray(foot + np.zeros(count), np.float32)
    here = points[np.arange(count), np.round(foot / SPACING).astype(int)]
    usual = (0.0, 0.0, filled.speed[:, 0], *np.zeros(car.states - 4))
    left, turned, speed, *body = (*beside, *usual[len(beside) :])
    start = np.zeros((count, car.states), np.float32)
    start[:, 0] = here[:, 0] - left * np.sin(here[:, 2])
    start[:, 1] = here[:, 1] + left * np.cos(here[:, 2])
    start[:, 2] = here[:, 2] + turned
    start[:, 3] = speed
    start[:, 4:] = np.transpose(body)
    seeds = np.arange(count) + 1000 * seed
    return Runs(start, foot, road=points.astype(np.float32), seed=seeds, now=filled)


def driven(drive, parts):
    """What is recorded of several rows that are driven as one."""
    ends = np.cumsum([0, *(len(runs.seed) for runs in parts.values())])
    together = jax.tree.map(
        lambda *all_parts: np.concatenate(all_parts), *parts.values()
    )
    made = drive(together)
    return {
        label: jax.tree.map(lambda leaf: leaf[first:last], made)
        for label, first, last in zip(parts, ends, ends[1:], strict=False)
    }


def distance(made):
    """|e_y|, infinite where it is not a number."""
    return np.where(np.isfinite(made["left"]), np.abs(made["left"]), np.inf)


def shown(value, digits=3):
    """A number as JSON has it: None if there is none."""
    return round(float(value), digits) if np.isfinite(value) else None


def back(made):
    """Whether each run is back at its end, and when it was last away [s]."""
    away = distance(made) > BACK
    turned = np.abs(made["turned"]) > BACK
    settled = ~(away | turned)[:, -20:].any(axis=1)
    last = away.shape[1] - np.argmax(away[:, ::-1], axis=1)
    return settled, PERIOD * np.where(away.any(axis=1), last, 0)


def returned(made, runs):
    """How many runs are back, when, and how the worst of them began."""
    settled, times = back(made)
    order = np.argsort(np.where(settled, times, np.inf))[::-1]
    worst = [
        {
            "run": int(run),
            "left": shown(made["left"][run, 0]),
            "yaw": shown(made["turned"][run, 0]),
            "v, body": [shown(x) for x in runs.start[run, 3:]],
            "friction, wind": [shown(x) for x in runs.now.env[run, 0]],
        }
        for run in order[: max(1, min(3, np.sum(~settled)))]
    ]
    return {
        "runs": len(settled),
        "back": int(settled.sum()),
        "median_s": shown(np.median(times[settled]), 1) if settled.any() else None,
        "worst_s": shown(np.max(times[settled], initial=0.0), 1),
        "slowest" if settled.all() else "failed": worst,
    }


def claimed(made, corridor):
    """Steps outside the certified corridor, those of them that are healthy, and steps
    farther away than `info` claims.
    """
    far = distance(made)
    healthy = made["healthy"]
    whole = {
        "runs": len(far),
        "departures": int((far > DEPARTED).any(axis=1).sum()),
        "largest_m": shown(far.max()),
    }
    # Without a shield nothing is claimed.
    if "bound" not in made:
        return whole
    claims = made["bound"]
    return whole | {
        "steps": far.size,
        "outside": int((far > corridor).sum()),
        "healthy_outside": int(((far > corridor) & healthy).sum()),
        "beyond_claim": int((np.isfinite(claims) & (far > claims)).sum()),
        "beyond_m": shown(np.nanmax(far - claims, initial=0.0)),
        "claimed": shown(np.isfinite(claims).mean(), 4),
        "healthy": shown(healthy.mean(), 4),
    }


OFFSETS = np.linspace(-20.0, 20.0, 21)
HEADINGS = np.linspace(-np.pi, np.pi, 17)
"""Starts of the figure [m, rad], at friction 0.6 without wind and 10 m/s."""


def starts(car, most):
    """The grid of 420; that of the figure; random ones on curved roads."""
    axes = (
        (0.3, 1.0, 1.5, 3.0, 8.0, 20.0, -20.0),
        (0.0, 0.5, -0.5, np.pi / 2, np.pi - 0.01),
        (6.0, 10.0),
        (0.3, 0.6, 0.9),
        (0.0, 8.0),
    )
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 5)
    at = at[np.linspace(0, len(at) - 1, min(most, len(at))).astype(int)]
    seen = np.stack(np.meshgrid(OFFSETS, HEADINGS, indexing="ij"), -1).reshape(-1, 2)
    seen = seen[:most]
    many = min(most, 2000)
    random = np.random.default_rng(3)
    low, high = np.asarray(car.loaded.certificate.measured.boxes.state)[:, 3:]
    beside = random.uniform(
        (-20.0, -np.pi, 2.0, *low), (20.0, np.pi, 12.0, *high), (many, 3 + len(low))
    )
    make = partial(runs_on, car, steps=200, seed=3)
    straight = partial(roads, seed=3, bends=0.0)
    quiet = np.asarray([0.6, 0.0])
    return {
        "grid": make(straight(len(at)), beside=(*at.T[:3],), env=at[:, None, 3:]),
        "basin": make(straight(len(seen)), beside=(*seen.T,), env=quiet),
        "random starts": make(
            roads(many, 3), foot=random.uniform(20, 150, many), beside=(*beside.T,)
        ),
    }


def start_rows(car, most):
    """Who comes back, from where, and when: planner, law, law of the box."""
    parts = starts(car, most)
    boxed = KINDS.index("linear")
    linear = {
        name: one._replace(now=one.now._replace(kind=one.now.kind + boxed))
        for name, one in parts.items()
    }
    ways = {
        "planner in the guard": driven(car.policy, parts),
        "law in the guard": driven(car.guarded, parts),
        "law of the box": driven(car.bare, linear),
    }
    for way, made in ways.items():
        for name in ("grid", "random starts"):
            yield f"{name}: {way}", returned(made[name], parts[name])
        # A letter a start: a for at once, b for 1 s, …; ~ for those that never return.
        settled, times = back(made["basin"])
        letters = np.where(settled, ord("a") + np.ceil(times), ord("~")).astype(int)
        yield f"basin: {way}", {"s": "".join(map(chr, letters))}


FAULTS = ("jump", "alternating", "yaw", "frozen", "late", "lost", "no e")


def faulty(car, many, longest):
    """Runs on S3 with one fault each, and the number of the fault.

    It lasts `longest` s, or up to 2 s if that is None (readings that are frozen or late:
    up to 1 s).
    """
    random = np.random.default_rng(4)
    fault = np.arange(many) % len(FAULTS)
    steps = 250
    is_ = {name: (fault == number)[:, None] for number, name in enumerate(FAULTS)}
    brief = random.uniform(0.1, np.where(is_["frozen"] | is_["late"], 1.0, 2.0))
    length = longest or brief
    step = np.arange(steps) - random.integers(50, 80, (many, 1))
    on = (step >= 0) & (PERIOD * step < length)
    size, angle = random.uniform((0.5, -np.pi), (10.0, np.pi), (many, 2)).T[..., None]
    moved = size * on * (is_["jump"] | (is_["alternating"] & (step % 2 == 0)))
    ways = moved * np.cos(angle), moved * np.sin(angle), on * is_["yaw"] * angle
    lag = np.where(is_["frozen"], step + 1, random.integers(1, 11, (many, 1)))
    road = roads(many, 4)
    unknown = is_["no e"] & (np.arange(steps) < 50)
    runs = runs_on(
        car,
        road,
        steps,
        4,
        offset=np.stack(ways, axis=-1),
        lag=np.where(on & (is_["frozen"] | is_["late"]), lag, 0),
        lost=on & is_["lost"],
        told=np.where(unknown[..., None], np.nan, road[1][:, :steps]),
    )
    return runs, fault


def fault_rows(car, most):
    """What each fault of the sensors does."""
    for label, longest in (("brief", None), ("5 s", 5.0)):
        runs, faults = faulty(car, min(most, 1000), longest)
        whole = car.policy(runs)
        for number, fault in enumerate(FAULTS[: most + 1]):
            mine = faults == number
            made = jax.tree.map(lambda leaf, mine=mine: leaf[mine], whole)
            found = claimed(made, car.corridor)
            turned = np.abs(made["turned"]) > np.pi / 2
            found["spins"] = int(turned.any(axis=1).sum())
            found["back"] = int(back(made)[0].sum())
            yield f"{fault}, {label}", found


def stop_rows(car, most):
    """Requests to brake at a random time of S3 under the law."""
    many = min(most, 1000)
    steps = 200
    road = roads(many, 5)
    onset = np.random.default_rng(5).integers(30, 90, (many, 1))
    time_ = np.arange(steps)
    for friction in (0.3, 0.7, "S3"):
        envs = road[1][:, :steps].copy()
        if friction != "S3":
            envs[..., 0] = friction
        asked = np.where(time_ < onset, 0, KINDS.index("brake"))
        runs = runs_on(car, road, steps, 5, env=envs, kind=asked)
        for way, drive in (("guard", car.guarded), ("bare", car.bare)):
            made = drive(runs)
            found = claimed(made, car.corridor)
            # Where it does not stand, the way until the end.
            stands = (made["state"][..., 3] < 0.1) & (time_ > onset)
            stands[:, -1] = True
            first = np.argmax(stands, axis=1)[:, None]
            along = partial(np.take_along_axis, made["along"], axis=1)
            far = np.where((time_ < onset) | (time_ > first), 0, distance(made))
            way_m = along(first) - along(onset)
            found["stand"] = int((first < steps - 1).sum())
            found["longest_m"] = shown(way_m.max(), 2)
            found["largest_m"] = shown(far.max())
            yield f"brake, friction {friction}: {way}", found


def deceptions(steps):
    """Errors that stay: label -> entries of `Now`."""
    time_ = PERIOD * np.arange(steps)[:, None]
    _, left, yaw = np.eye(3)
    side = np.where(np.floor(time_[:, 0] / 2.0) % 2 == 0, 0.0, 0.1)
    made = {
        "nothing": {},
        "drift 1 cm/s": {"offset": 0.01 * time_ * left},
        "yaw bias 0.03 rad": {"offset": 0.03 * yaw},
        "reference moves 0.1 m": {"aside": side},
        "NaN for good": {"lost": time_[:, 0] >= 5.0},
        "steering offset 3.0 degrees": {"steering": np.deg2rad(3.0)},
    }
    return made | {f"position bias {b} m": {"offset": b * left} for b in (0.05, 0.15)}


def in_class(car, many, seed=6):
    """Runs under the conditions of the certificate."""
    about = car.loaded.certificate.corridor.conditions
    limits = scenarios.DriveClass(
        *(getattr(about, x) for x in scenarios.DriveClass._fields)
    )
    length = {"steps": LONGEST, "dt": PERIOD}
    drive = partial(scenarios.random_drive, limits=limits, **length)
    keys = jax.random.split(jax.random.key(seed), many)
    groups = jnp.arange(many) % len(scenarios.DRIVES)
    speeds, turns = map(np.asarray, jax.jit(jax.vmap(drive))(keys, groups))
    along = PERIOD * np.cumsum(speeds, axis=1)
    bends = [
        np.interp(SPACING * np.arange(POINTS), *one)
        for one in zip(along, turns, strict=True)
    ]
    low, high = about.env_box
    box = {"low": low, "high": high, "dwell": about.dwell_s}
    switching = partial(random_switching, **length, **box)
    road = roads(many, seed, switching, np.stack(bends))
    return runs_on(car, road, LONGEST, seed, speed=speeds)


ONSET = 60
"""Call at which a lasting error begins."""


def detection_rows(car, most):
    """When a steering angle 1° off is found in the class: by the law, and with its ν."""
    many = min(most, 1000)
    steps = 200
    random = np.random.default_rng(11)
    runs = in_class(car, many, seed=11)
    runs = runs._replace(now=jax.tree.map(lambda x: x[:, :steps], runs.now))
    about = car.loaded.certificate.corridor.conditions
    # As in the data: an AR(1) process, for a quarter of the runs its sign.
    ends = np.log([about.steering_excitation, about.speed_excitation])
    sizes = np.exp(random.uniform(*ends.T, (many, 1, 2))) / about.perturbation
    noise = lfilter([0.527], [1, -0.85], random.normal(size=(many, steps, 2)), axis=1)
    noise = np.where(random.uniform(size=(many, 1, 1)) < 0.25, np.sign(noise), noise)
    nu = np.clip(sizes * noise, -1.0, 1.0).astype(np.float32)
    change = np.deg2rad(1.0) * (np.arange(steps) >= ONSET)
    change = runs.now.steering + change * random.choice((-1, 1), (many, 1))
    under_law = runs.now._replace(steering=change.astype(REAL))
    in_the_class = under_law._replace(nu=nu)
    for way, now in (("law", under_law), ("class", in_the_class)):
        alarm = car.guarded(runs._replace(now=now))["alarm"]
        found = alarm[:, ONSET + 1 :]
        late = PERIOD * (np.argmax(found, axis=1) + 1.0)
        late = np.where(found.any(axis=1), late, np.inf)
        median, slowest = np.quantile(late, (0.5, 0.99), method="inverted_cdf")
        row = {
            "before": int(alarm[:, : ONSET + 1].any(axis=1).sum()),
            "runs": len(late),
            "within_3s": shown((late < 3.05).mean(), 4),
            "s_50": shown(median, 1),
            "s_99": shown(slowest, 1),
        }
        yield f"steering offset 1.0 degrees, {way}", row


def table_rows(car, most):
    """Lasting errors, and the class itself: what is claimed, and how often."""
    road = roads(min(most, 24), 7)
    parts = {
        label: runs_on(car, road, LONGEST, 7, **now)
        for label, now in deceptions(LONGEST).items()
    }
    parts["class"] = in_class(car, min(most, 150))
    for label, made in driven(car.policy, parts).items():
        found = claimed(made, car.corridor)
        found["rmse_mm"] = shown(1e3 * np.sqrt(np.mean(made["left"][:, 20:] ** 2)), 2)
        found["runs_not_healthy"] = int((~made["healthy"]).any(axis=1).sum())
        yield label, found


def planner_rows(car, most):
    """Planners that try to drive the car off its road."""
    random = np.random.default_rng(10)
    many = min(most, 200)
    side = random.choice((-1.0, 1.0), (many, 1, 2))
    share = PERIOD * np.arange(LONGEST)[:, None] / random.uniform(1, 8, (many, 1, 1))
    asked = {
        "nothing": ("law", 0.0),
        "worst": ("worst", 0.0),
        "bang-bang": ("law", side * np.where(share % 1.0 < 0.5, 1.0, -1.0)),
        "random": ("law", random.choice((-1.0, 1.0), (many, LONGEST, 2))),
        "constant": ("law", side),
        "NaN": ("NaN", 0.0),
        "full lock": ("lock", side),
    }
    road = roads(many, 10)
    parts = {
        label: runs_on(car, road, LONGEST, 10, kind=KINDS.index(kind), nu=nu)
        for label, (kind, nu) in asked.items()
    }
    for way, drive in (("guard", car.guarded), ("bare", car.bare)):
        for label, made in driven(drive, parts).items():
            worst = distance(made).max(axis=1)
            found = claimed(made, car.corridor)
            found["inside"] = shown((worst <= car.corridor).mean(), 4)
            found["left_the_lane"] = int((worst > car.room).sum())
            yield f"planner {label}: {way}", found


ROWS = {
    "starts": start_rows,
    "faults": fault_rows,
    "stops": stop_rows,
    "tables": table_rows,
    "planners": planner_rows,
    "detection": detection_rows,
}


def main():
    """Drive, print and write."""
    options = arguments(
        __doc__,
        __file__,
        cars=CARS,
        rows=ROWS,
        runs=10_000,
        samples=1500,
        batch=16 if jax.default_backend() == "cpu" else 512,
    )
    head = {"samples": options.samples, "device": jax.devices()[0].device_kind}
    began = time.perf_counter()
    rows = []
    for name in options.cars:
        car = Car(name, options.samples, options.batch)
        made_by = stamp(f"{name}_path")
        for group in options.rows:
            for label, found in ROWS[group](car, options.runs):
                rows.append({"car": name, "row": label} | found | made_by)
                print(f"{time.perf_counter() - began:6.1f} s", rows[-1], flush=True)
            # After every group: a run that is cut off has what it measured.
            write(options.out, head, rows)


if __name__ == "__main__":
    main()
