"""What was aimed at, against what the JSON files say."""

import itertools
from contextlib import suppress

from benchmarks.markdown import table
from benchmarks.timing.tables import LABELS, read

JAX_PEERS = ("jax_mppi", "evosax_cma_es")
KINDS = ("best", "median")


def speeds():
    """Against other libraries; those that did not run are passed over."""
    step = read("control_step")["contenders"]
    for name, kind in itertools.product(("sfkd_jax", "sfkd_jax_sharded"), KINDS):
        times = {label: row[f"{kind}_ms"] for label, row in step.items()}
        if "pytorch_mppi" in times:
            yield (
                f"{LABELS[name]}: times as fast as pytorch-mppi, {kind}",
                ">= 2.4",
                times["pytorch_mppi"] / times[name],
            )
        peers = [times[peer] for peer in JAX_PEERS if peer in times]
        if peers:
            yield (
                f"{LABELS[name]}: times as fast as the best JAX library, {kind}",
                ">= 1.25",
                min(peers) / times[name],
            )
    for name in ("own_model", "own_model_sharded"):
        yield f"{LABELS[name]}, best [ms]", "<= 5.5", step[name]["best_ms"]


def tails():
    """In real time."""
    result = read("realtime")["contenders"]
    for name in ("sfkd_jax", "own_model"):
        alone, beside = result[name]["alone"], result[name]["beside"]
        yield (
            f"{LABELS[name]}: p99 beside a busy process [ms]",
            "<= 20",
            beside["p99_ms"],
        )
        yield (
            f"{LABELS[name]}: steps above 100 ms of {alone['steps']}",
            "<= 0",
            alone["missed"],
        )


def growth():
    """Temperature, samples, episodes, compiling."""
    parts, scale = read("own_profile")["parts"], read("scaling")
    result = (
        parts["whole step, 30 effective samples"]["best_ms"]
        - parts["whole step"]["best_ms"]
    )
    yield "finding the temperature [ms]", "<= 0.3", result
    yield (
        "exponent of the growth in samples, from 1500 on",
        "<= 1.05",
        scale["exponents"]["sfkd_jax"]["from_1500"],
    )
    yield (
        "episode in one scan, over steps x step time",
        "<= 1.05",
        scale["episode"]["ratio"],
    )
    for name, both in scale["compile"].items():
        for kind, most, words in (("cold", 3.0, "no cache"), ("warm", 0.5, "cached")):
            yield (
                f"trace and compile, {name}, {words} [s]",
                f"<= {most}",
                both[kind]["trace_s"] + both[kind]["compile_s"],
            )


def targets():
    """All of them that were measured."""
    rows = []
    for part in (speeds, tails, growth):
        with suppress(FileNotFoundError):
            rows += part()
    return table(
        ["", "target", "found", "met"],
        [[*row[:2], f"{row[2]:.2f}", actual(*row[1:])] for row in rows],
    )


def actual(target, value):
    """yes or no."""
    sign, number = target.split()
    return (
        "yes"
        if (value >= float(number) if sign == ">=" else value <= float(number))
        else "no"
    )
