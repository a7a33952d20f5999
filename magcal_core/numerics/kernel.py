"""Kernels: functions that numba compiles once, and that a later process takes from the disk as they are.

Notes
-----
A kernel that takes sums, medians or ``any`` from numpy, or assigns to a slice, has numba's modules for them loaded with
it, and `scipy.linalg` for the first: what every calibration runs writes such things as loops. The small ones that
several kernels need are here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Literal, TypeVar, cast

from numba import njit
from numba.core.base import BaseContext
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.typing.templates import Signature

from magcal_core.arrays import Floats

F = TypeVar("F", bound=Callable[..., object])


class KernelCache(FunctionCache):
    """Numba's cache, without the modules that only a compiler needs.

    Notes
    -----
    Numba imports what it can compile, some forty modules of its own and `scipy.linalg` with them, before it looks
    whether a kernel is on the disk: a third of the time of a command that calibrates once. A kernel on the disk needs
    none of them; one that is not there is compiled, and the compiler imports them itself.
    """

    def load_overload(self, sig: Signature, target_context: BaseContext) -> CompileResult | None:
        """Return the kernel for the signature from the disk, None where it is not there."""
        rtsys.initialize(target_context)
        found: CompileResult | None = self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return found


def kernel(
    *,
    inline: Literal["never", "always"] = "never",
    error_model: Literal["python", "numpy"] = "python",
    fastmath: Collection[str] = (),
) -> Callable[[F], F]:
    """Return the decorator of a function that is compiled for the types it is called with; it runs without the GIL.

    Parameters
    ----------
    inline : {"never", "always"}
        Whether the function becomes a part of each kernel that calls it.
    error_model : {"python", "numpy"}
        Whether division by zero raises, or gives inf and NaN.
    fastmath : collection of str
        What the compiler may do to sums of floats, by LLVM's names.
    """

    def compiled(function: F) -> F:
        made = njit(nogil=True, inline=inline, error_model=error_model, fastmath=set(fastmath))(function)
        if isinstance(made, Dispatcher):  # numba hands the function back as it is where NUMBA_DISABLE_JIT is set
            made._cache = KernelCache(made.py_func)  # type: ignore[attr-defined, no-untyped-call]
        return cast("F", made)

    return compiled


@kernel()
def copy_into(out: Floats, values: Floats) -> None:  # pragma: no cover - compiled
    """Leave ``values`` in ``out``, both shape (n,)."""
    for i in range(out.size):
        out[i] = values[i]


@kernel()
def add_to(total: Floats, part: Floats) -> None:  # pragma: no cover - compiled
    """Add ``part`` to ``total``, both shape (m, n)."""
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            total[i, j] += part[i, j]


@kernel()
def has_weight(weights: Floats) -> bool:  # pragma: no cover - compiled
    """Return whether any of the weights, shape (n,), is not zero."""
    for i in range(weights.size):  # noqa: SIM110 - a compiled generator is slower than its loop
        if weights[i] != 0.0:
            return True
    return False
