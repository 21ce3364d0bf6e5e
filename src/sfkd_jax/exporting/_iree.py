"""The route to C and C++: StableHLO compiled by IREE to a module that its runtime loads without Python."""

from __future__ import annotations

from collections.abc import Sequence

from sfkd_jax.exporting._programs import Program, lowered
from sfkd_jax.exporting._weights_first import weights_first


def compile_iree(program: Program, *, flags: Sequence[str] = ()) -> bytes:
    """An IREE module (.vmfb) for processors, its function `main`; arguments and results as in the manifest.

    Args:
        program: what to compile.
        flags: for iree-compile, for example the processor or the target triple.

    Raises:
        ValueError: IREE is not installed, or does not compile this program; with its
            first complaint.
    """
    try:
        from iree import compiler  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            "export.iree=true needs IREE: pip install 'sfkd-jax[cpp]'"
        ) from None
    text = lowered(weights_first(program), program, ("cpu",)).mlir_module()
    try:
        return compiler.compile_str(
            text,
            input_type="stablehlo",
            target_backends=["llvm-cpu"],
            extra_args=list(flags),
        )
    except compiler.CompilerToolError as error:
        complaint = str(error).partition("Diagnostics:\n")[2] or str(error)
        raise ValueError(
            f"iree-compile failed: {complaint.splitlines()[0][:300]}"
        ) from error
