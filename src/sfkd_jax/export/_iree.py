"""Compile StableHLO with IREE to modules for C and C++."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jaxtyping import Array

from sfkd_jax.export._programs import Program, input_shapes, lower


def compile_iree(program: Program, *, flags: Sequence[str] = ()) -> bytes:
    """Return an IREE module (.vmfb) for CPUs, with the function `main`.

    Arguments and results are those of the manifest.

    Args:
        program: to compile.
        flags: for iree-compile, such as the processor or the target triple.

    Raises:
        ValueError: IREE is not installed, or does not compile this program; with its
            first error.
    """
    try:
        from iree import compiler  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            "export.iree=true needs IREE: pip install 'sfkd-jax[cpp]'"
        ) from None
    text = lower(fold_constants(program), program, ("cpu",)).mlir_module()
    try:
        return compiler.compile_str(
            text,
            input_type="stablehlo",
            target_backends=["llvm-cpu"],
            extra_args=list(flags),
        )
    except compiler.CompilerToolError as error:
        message = str(error).partition("Diagnostics:\n")[2] or str(error)
        raise ValueError(
            f"iree-compile failed: {message.splitlines()[0][:300]}"
        ) from error


def fold_constants(program: Program) -> Callable[..., list[Array]]:
    """Return the same function with all operations on constants replaced by results.

    IREE has no LAPACK and cannot compile factorisations. With folded parameters one
    model still has factorisations of its weights: ControlSynth, for the inverse of its
    metric's factor. Factorisations in every control step remain: those of the quadratic
    program of `koopman_mpc` and the eigenvectors of `curvature`. The rounding differs
    from that of a single program.
    """
    closed = jax.make_jaxpr(program.function)(*input_shapes(program))
    jaxpr = closed.jaxpr
    known, ahead, rest = set(jaxpr.constvars), [], []
    for equation in jaxpr.eqns:
        constant = not equation.effects and all(
            _is_known(atom, known) for atom in equation.invars
        )
        (ahead if constant else rest).append(equation)
        known |= set(equation.outvars) if constant else set()
    wanted: list[Any] = [atom for equation in rest for atom in equation.invars] + list(
        jaxpr.outvars
    )
    border = list(
        dict.fromkeys(
            atom for atom in wanted if isinstance(atom, Var) and atom in known
        )
    )
    names = jaxpr.debug_info.with_unknown_names()
    first = jaxpr.replace(invars=[], outvars=border, eqns=ahead, debug_info=names)
    values = jax.jit(jaxpr_as_fun(ClosedJaxpr(first, closed.consts)))()
    remaining = jaxpr_as_fun(
        ClosedJaxpr(
            jaxpr.replace(constvars=border, eqns=rest, debug_info=names), values
        )
    )
    return wraps(program.function)(lambda *leaves: remaining(*leaves))


def _is_known(atom: Any, known: set[Any]) -> bool:
    return isinstance(atom, Literal) or atom in known
