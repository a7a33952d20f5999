"""Kernels: functions that numba compiles once, and that a later process takes from the disk as they are.

Notes
-----
A kernel that takes sums, medians or ``any`` from numpy, or assigns to a slice, has numba's modules for them loaded with
it, and `scipy.linalg` for the first: what every calibration runs writes such things as loops. The small ones that
several kernels need are here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cache
from typing import TYPE_CHECKING, Final, Literal, TypeVar, cast

from llvmlite.binding import ModuleRef, add_symbol, parse_bitcode  # type: ignore[import-untyped]
from numba import njit
from numba.core.base import BaseContext
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, compile_result
from numba.core.dispatcher import Dispatcher
from numba.core.environment import Environment
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.typing.templates import Signature

from magcal_core.arrays import Floats

if TYPE_CHECKING:
    from numba.core.cpu import CPUContext

Payload = tuple[
    tuple[str, str, tuple[bytes, bytes]],
    object,
    Environment,
    object,
    bool,
    object,
    str,
    tuple[Callable[[], None], ...],
    tuple[Environment, ...],
]
"""What numba writes of a compiled function: its library (name, kind, machine code and bitcode), description, own
environment, signature, whether it is in object mode, lifted loops, types as text, initialisers, other environments."""
LAYOUT: Final = "without empty environments"
"""Stands in the name of what is on the disk: files of another layout are not taken, and written anew."""

F = TypeVar("F", bound=Callable[..., object])


class KernelLibrary(JITCodeLibrary):
    """Machine code from the disk, which runs as it is.

    Notes
    -----
    The bitcode beside it serves a compiler that takes the kernel into another one. Numba reads it with each kernel and
    notes its names, half of the time that a kernel takes to come from the disk; here that waits for a compiler to ask.
    """

    _bitcode: bytes

    @classmethod
    def of(cls, codegen: object, name: str, object_code: bytes, bitcode: bytes) -> KernelLibrary:
        """Return the library of what the disk has."""
        library = cls(codegen, name)
        library.enable_object_caching()  # type: ignore[no-untyped-call]
        library._set_compiled_object(object_code)  # type: ignore[no-untyped-call]
        library._bitcode = bitcode
        library._finalize_final_module()  # type: ignore[no-untyped-call]
        return library

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function of the machine code, zero where there is none of that name."""
        return int(self._codegen._engine.get_function_address(name))

    def _get_module_for_linking(self) -> ModuleRef:
        if self._shared_module is None:
            self._shared_module = parse_bitcode(self._bitcode)
            self._codegen._engine._load_defined_symbols(self._shared_module)  # type: ignore[no-untyped-call]
        return self._shared_module


class KernelFiles(CompileResultCacheImpl):
    """How a compiled kernel is written to the disk and taken from there.

    Notes
    -----
    As numba does it, but for the environments of numba's own functions that a kernel calls, such as ``np.empty``: they
    hold what a function reads as Python objects. Those that hold nothing are left out, and with them the import of
    numba's modules that they are of.
    """

    def reduce(self, cres: CompileResult) -> Payload:
        """Return what is written of a compiled kernel."""
        payload: Payload = cres._reduce()  # type: ignore[no-untyped-call]
        return (*payload[:-1], tuple(one for one in payload[-1] if one.consts or not _is_numbas(one)))

    def rebuild(self, target_context: CPUContext, payload: Payload) -> CompileResult:
        """Return the kernel that ``payload`` describes, as numba's ``CompileResult._reduce`` made it."""
        (name, _, codes), fndesc, environment, signature, objectmode, lifted, annotation, reload_init, others = payload
        for initialise in reload_init:
            initialise()
        library = KernelLibrary.of(target_context.codegen(), name, *codes)  # type: ignore[no-untyped-call]
        entry_point = target_context.get_executable(library, fndesc, environment)  # type: ignore[no-untyped-call]
        for other in others:
            library.codegen.set_env(other.env_name, other)
        made: CompileResult = compile_result(  # type: ignore[no-untyped-call]
            target_context=target_context,
            typing_context=target_context.typing_context,
            library=library,
            environment=environment,
            entry_point=entry_point,
            fndesc=fndesc,
            type_annotation=annotation,
            signature=signature,
            objectmode=objectmode,
            lifted=lifted,
            reload_init=reload_init,
            referenced_envs=others,
        )
        return made


class KernelCache(FunctionCache):
    """Numba's cache, without the modules that only a compiler needs.

    Notes
    -----
    Numba imports what it can compile, some forty modules of its own and `scipy.linalg` with them, before it looks
    whether a kernel is on the disk: a third of the time of a command that calibrates once. A kernel on the disk needs
    none of them; one that is not there is compiled, and the compiler imports them itself.
    """

    _impl_class = KernelFiles

    def _index_key(self, sig: Signature, codegen: object) -> tuple[object, ...]:
        return (*super()._index_key(sig, codegen), LAYOUT)  # type: ignore[no-untyped-call]

    def load_overload(self, sig: Signature, target_context: BaseContext) -> CompileResult | None:
        """Return the kernel for the signature from the disk, None where it is not there."""
        _name_helpers()
        found: CompileResult | None = self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return found


@cache
def _name_helpers() -> None:
    """Give the linker the addresses of numba's own helpers in C, which make and free arrays.

    Numba compiles its counters of references as well before it takes the first kernel from the disk; a kernel there has
    them in itself, and the compiler asks for them itself.
    """
    for name, address in _nrt_python.c_helpers.items():
        add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _is_numbas(environment: Environment) -> bool:
    return str(environment.globals.get("__name__")).startswith("numba.")


def _nothing() -> None:
    """Do nothing."""


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
            # Extensions that other distributions bring to numba are looked for in all metadata; no kernel needs one.
            made._compilation_chain_init_hook = _nothing  # type: ignore[attr-defined]
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
