"""Compile StableHLO with IREE to modules for C and C++."""

from __future__ import annotations

from collections.abc import Sequence

from sfkd_jax.export._constants import fold_constants
from sfkd_jax.export._programs import Program, lower


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
