"""Compiled kernels are optimised and turned into machine code once, where Python calls them.

numba makes machine code of every function that a kernel calls, with a wrapper each for Python and for C, and optimises it again in each
kernel that calls it, however indirectly: two thirds of the time of a kernel's first call. Here what a kernel calls stays a plain module,
which is linked where it is needed; all is optimised together, once. No option of the compiler changes; the
pictures of all methods kept their bits.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import llvmlite.binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.targetconfig import TargetConfig


def link_once(kernel: Any) -> None:
    """Let other kernels call a twin of this one that has no machine code of its own, and compile it as this module describes.

    Kernels with loops in parallel are compiled as numba does: it takes pointers to their parts meanwhile. So are those that may reorder
    sums: how depends on what is optimised together.
    """
    options, kind = kernel.targetoptions, JITCodeLibrary
    if not (options.get("parallel") or _reorders(options.get("fastmath", False))):
        kind = _LinkedOnce
        twin = cache(lambda: _twin(kernel))  # kernels that are loaded need none
        kernel.get_call_template = lambda args, kws: twin().get_call_template(args, kws)
        kernel.get_overload = lambda signature: twin().get_overload(signature)
    compile_now = kernel.compile

    def compile_as(signature: Any) -> Any:
        with global_compiler_lock, _libraries_of(kernel.targetctx.codegen(), kind):
            return compile_now(signature)

    kernel.compile = compile_as


def _twin(kernel: Any) -> Any:
    """Return what other kernels call in place of this one."""
    twin = type(kernel)(kernel.py_func, targetoptions={**kernel.targetoptions, "no_cpython_wrapper": True, "no_cfunc_wrapper": True})
    twin._compiling_counter = kernel._compiling_counter  # what calls itself is recognised by it
    return twin


def _reorders(fastmath: bool | set[str]) -> bool:
    return fastmath is True or (isinstance(fastmath, set) and not fastmath <= {"contract"})


class _LinkedOnce(JITCodeLibrary):  # type: ignore[misc]
    """The code of one function, whose callees are linked and optimised when an address in it is asked for, and not before."""

    @property
    def codegen(self) -> Any:
        return self._codegen if self._finalized else _NoEnvironmentYet(self._codegen)

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave it to the passes over the whole module: with these, each function would be optimised once for every module it is in."""
        ll_module.data_layout = self._codegen._data_layout

    def add_linking_library(self, library: Any) -> None:
        self._linking_libraries.append(library)

    def get_pointer_to_function(self, name: str) -> int:
        if not self._finalized and not _defines(self._final_module, name):
            return 0
        return super().get_pointer_to_function(name)

    def finalize(self) -> None:
        codegen: Any = self._codegen
        self._raise_if_finalized()
        seen, waiting = {self}, self._linking_libraries[::-1]
        while waiting:
            library = waiting.pop()
            if library not in seen:
                seen.add(library)
                self._reload_init.update(library._reload_init)
                if isinstance(library, _LinkedOnce) and not library._finalized:
                    waiting += library._linking_libraries[::-1]
                    self._final_module.link_in(library._for_many(), preserve=True)
                else:
                    self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._shared_module = None
        self._optimize_final_module()
        self._final_module.verify()
        self._finalize_final_module()
        for variable in self._final_module.global_variables:
            environment = lookup_environment(variable.name) if variable.name.startswith("_ZN08NumbaEnv") else None
            if environment is not None:
                codegen.set_env(variable.name, environment)

    def _for_many(self) -> Any:
        """Return the module, for libraries that may each have a copy of it."""
        if self._shared_module is None:
            self._shared_module = self._final_module.clone()
            for function in self._shared_module.functions:
                if not function.is_declaration and function.linkage == llvm.Linkage.external:
                    function.linkage = "linkonce_odr"
        return self._shared_module


@cache
def _hash_of(options: type) -> int:
    return hash(tuple(sorted(options.options)))  # type: ignore[attr-defined]


def _are_alike(self: Any, other: Any) -> Any:
    if type(other) is not type(self):
        return _compare(self, other)
    return all(getattr(self, name) == getattr(other, name) for name in self._values.keys() | other._values.keys())


# numba's options all have one hash, for which it reads and sorts all of them, and each look into its caches compares all of them:
# a thirteenth of the time of compiling. These give the same answers from what is set.
_compare = TargetConfig.__eq__
TargetConfig.__hash__ = lambda self: _hash_of(type(self))  # type: ignore[method-assign]
TargetConfig.__eq__ = _are_alike  # type: ignore[method-assign, assignment]


class _NoEnvironmentYet:
    """Stands for the code generator of a library without addresses, in which a function's globals cannot be put down yet."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def set_env(self, name: str, environment: Any) -> None:
        """Leave it to the library that is made into machine code."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)


@contextmanager
def _libraries_of(codegen: Any, kind: type) -> Iterator[None]:
    """Make libraries of this kind meanwhile, and leave the many parts of a program that is compiled to later: that is a tenth faster."""
    before, collects = codegen._library_class, gc.isenabled()
    codegen._library_class = kind
    gc.disable()
    try:
        yield
    finally:
        codegen._library_class = before
        if collects:
            gc.enable()


def _defines(module: Any, name: str) -> bool:
    try:
        return not module.get_function(name).is_declaration
    except NameError:
        return False
