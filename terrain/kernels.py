"""Compiled functions, cached by what they are, and the records that they take.

**Cache.**  :func:`njit` is numba's, but a compiled function is found again by its content: a digest of its
bytecode and constants and of every global that it reads, through all functions that it calls.  numba's own cache
compares one file only, so that a constant or a callee of another file stays what it was when that file changes;
here a change compiles what it reaches, and nothing else.  The cache lies in the user's cache folder, so that
copies, virtual environments and updates of the package share it.

**Records** are named numbers and arrays that compiled functions take, and write in place, as one argument: one
element of a structured array.  What a plant, a filter, a controller or an observer is made of (parameters),
remembers (state) and takes at a step (row) is one record each, so that a step reads
``step(params[0], state[0], row[0], dt_s)``, a snapshot is a copy of the array, and no number has a place.  From
Python pass the arrays, and take their elements 0 in compiled code: numba knows an array's type at once.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dis import get_instructions
from enum import Enum
from functools import cache, partial
from hashlib import sha256
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core import typeinfer, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from terrain.records import Array

#: A compiled function that was not loaded for so long is removed when another one is saved.
UNUSED_S = 60 * 86400.0


def cache_folder() -> Path:
    """Return where compiled functions lie: below NUMBA_CACHE_DIR, XDG_CACHE_HOME or ``~/.cache``."""
    named = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    return Path(named or "~/.cache").expanduser() / "terrain-kernels"


def njit(*signatures: Any, **options: Any) -> Any:
    """Compile a function as :func:`numba.njit` does, and cache it by its content.

    Parameters
    ----------
    signatures : of numba, for a function that is compiled when it is defined; none for one that is compiled when
        it is called
    options : of :func:`numba.njit`, but ``cache``

    Raises
    ------
    TypeError
        when it is first called, where the function reads a global of a kind whose content is not known.

    Examples
    --------
    >>> @njit
    ... def doubled(x):
    ...     return 2.0 * x
    >>> doubled(1.5)
    3.0
    """
    if not (len(signatures) == 1 and isinstance(signatures[0], FunctionType)):
        return partial(_compiled, signatures=signatures, options=options)
    return _compiled(signatures[0], (), options)


def inner(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that compiled functions call, and nothing else: :func:`njit`, a fifth faster.

    It has no entry for Python, from where its ``py_func`` is called; a call of itself raises a TypeError.
    """
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**options) if function is None else _compiled(function, (), options)


def _compiled(function: Callable[..., Any], signatures: Sequence[Any], options: dict[str, Any]) -> Any:
    kernel = numba.njit(**options)(function)
    if not isinstance(kernel, Dispatcher):  # NUMBA_DISABLE_JIT
        return kernel
    vars(kernel)["_cache"] = _ContentCache(function, options)
    if "no_cpython_wrapper" in options:  # numba would call the entry that is not there

        def refuse(*_: Any, **__: Any) -> None:
            raise TypeError(f"{function.__qualname__} is called by compiled functions only; call its py_func")

        def keep(found: Any) -> None:
            kernel.overloads[tuple(found.signature.args)] = found

        vars(kernel).update(_compile_for_args=refuse, add_overload=keep)
    if signatures:
        with typeinfer.register_dispatcher(kernel):
            for signature in signatures:
                kernel.compile(signature)
            kernel.disable_compile()
    return kernel


def content_digest(function: Callable[..., Any], options: Mapping[str, Any] | None = None) -> str:
    """Return a digest of a function: its code, its options, and all globals that it reads, through what it calls.

    Raises
    ------
    TypeError
        where it reads a global of a kind whose content is not known.
    """
    digest = sha256(f"{numba.__version__} {np.__version__} {sorted((options or {}).items())}".encode())
    seen: set[int] = set()
    waiting: list[Any] = [function]
    while waiting:
        value = waiting.pop()
        if isinstance(value, Dispatcher):
            digest.update(repr(sorted(value.targetoptions.items())).encode())
            value = value.py_func
        if isinstance(value, FunctionType):
            if id(value) in seen:
                continue
            seen.add(id(value))
            digest.update(f"{value.__module__}.{value.__qualname__}".encode())
            if value.__module__.partition(".")[0] in ("numba", "numpy", "math"):
                continue
            waiting += [value.__defaults__, tuple((value.__kwdefaults__ or {}).items())]
            waiting += map(attrgetter("cell_contents"), value.__closure__ or ())
            waiting += _globals_read(value.__code__, value.__globals__, digest)
        elif isinstance(value, (tuple, list, frozenset)):
            digest.update(f"{type(value).__name__} {len(value)}".encode())
            waiting += value if not isinstance(value, frozenset) else sorted(value, key=repr)
        elif isinstance(value, np.ndarray):
            digest.update(f"{value.dtype.descr} {value.shape}".encode() + value.tobytes())
        elif isinstance(value, type) and issubclass(value, Enum):
            digest.update(repr([(member.name, member.value) for member in value]).encode())
        elif isinstance(value, type):
            fields, defaults = getattr(value, "_fields", ()), getattr(value, "_field_defaults", {})
            digest.update(f"{value.__module__}.{value.__qualname__} {fields} {defaults}".encode())
        elif isinstance(value, ModuleType):
            digest.update(value.__name__.encode())
        elif isinstance(value, _PLAIN):
            digest.update(f"{type(value).__name__} {value!r}".encode())
        elif callable(value) and getattr(value, "__module__", None) in ("builtins", "math", "numpy", "numba"):
            digest.update(repr(getattr(value, "__name__", value)).encode())
        else:
            raise TypeError(
                f"{function.__module__}.{function.__qualname__} reads {value!r}, a {type(value).__name__}, "
                "by which a compiled function cannot be cached"
            )
    return digest.hexdigest()


_PLAIN = (
    int,
    float,
    complex,
    str,
    bytes,
    Enum,
    np.generic,
    np.dtype,
    np.ufunc,
    range,
    types.Type,
    type(None),
)


def _globals_read(code: CodeType, names: Mapping[str, Any], digest: Any) -> list[Any]:
    """Return the values of the globals that code reads, by their names' order, and digest the code itself."""
    digest.update(code.co_code + repr((code.co_names, code.co_varnames)).encode())
    read = []
    # of lambdas and comprehensions the first constant is no docstring
    first = code.co_consts[0] if code.co_consts and not code.co_name.startswith("<") else None
    for constant in code.co_consts[1 if isinstance(first, str) else 0 :]:
        if isinstance(constant, CodeType):
            read += _globals_read(constant, names, digest)
        else:
            read.append(constant)
    for name in _loaded_names(code):
        if name in names:
            value = names[name]
            read.append(value)
            if isinstance(value, ModuleType) and value.__name__.partition(".")[0] in ("terrain", "features"):
                read += [vars(value)[attribute] for attribute in code.co_names if attribute in vars(value)]
    return read


@cache
def _loaded_names(code: CodeType) -> list[str]:
    """Return the names that code loads as globals, and not as attributes or fields of the same name."""
    return sorted({step.argval for step in get_instructions(code) if step.opname == "LOAD_GLOBAL"})


class _ContentCache(FunctionCache):
    """Numba's cache of one function, in files named by its content.

    The content is read when it is first needed, as functions that it calls may be defined after it.  It is the locator
    of how numba writes a compiled function, which asks it for its folder.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        self._name, self._py_func, self._options = repr(function), function, options
        self._impl = CompileResultCacheImpl.__new__(CompileResultCacheImpl)
        code = function.__code__
        vars(self._impl).update(_lineno=code.co_firstlineno, _py_file=code.co_filename, _locator=self)
        self.enable()

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        """Return what distinguishes overloads in a file: numba would add closures, which differ in each process."""
        return signature, codegen.magic_tuple()

    def _load_overload(self, signature: Any, target_context: Any) -> Any:
        self._place()
        with suppress(OSError):  # a folder that cannot be read
            return super()._load_overload(signature, target_context)
        return None

    def _save_overload(self, signature: Any, data: Any) -> None:
        try:
            self._place()
            super()._save_overload(signature, data)
        except OSError:  # a folder that cannot be written: compiled anew in each process
            self.disable()

    def _place(self) -> None:
        if not hasattr(self, "_cache_file"):
            name = f"{self._py_func.__name__.strip('<>')}-{content_digest(self._py_func, self._options)[:32]}"
            self._cache_path = str(cache_folder())
            self._cache_file = IndexDataCacheFile(self._cache_path, name, "")

    def ensure_cache_path(self) -> None:
        """Make the folder, for this user only, and remove what is used no more, once a process."""
        _make_folder(cache_folder())


@cache
def _make_folder(folder: Path) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    oldest_s = time.time() - UNUSED_S
    for file in folder.iterdir():
        with suppress(OSError):  # another process may remove it first
            if max(file.stat()[7:9]) < oldest_s:  # read, or written
                file.unlink()


def record(fields: Mapping[str, Any]) -> np.dtype[Any]:
    """Return the type of a record.

    Parameters
    ----------
    fields : by name ``float``, ``int``, ``bool``, another record, or any of these with a shape, as
        ``(float, 3)`` or ``(LINE, 29)``; flags are of a byte each, as compiled code has no arrays of bits

    Examples
    --------
    >>> wheel = record({"speed_mps": float, "forces_n": (float, 2)})
    >>> robot = record({"wheels": (wheel, 3), "time_s": float})
    >>> filled(robot, np.nan)[0]["wheels"][1]["forces_n"]
    array([nan, nan])
    """
    members = []
    for name, field in fields.items():
        kind, shape = field if isinstance(field, tuple) else (field, ())
        members.append((name, np.uint8 if kind is bool else kind, shape))
    return np.dtype(members, align=True)


def numbers(names: str) -> dict[str, Any]:
    """Return the fields of a record that are one number each, from their names in a row.

    Examples
    --------
    >>> record(numbers("x_m y_m") | {"n": int}).names
    ('x_m', 'y_m', 'n')
    """
    return dict.fromkeys(names.split(), float)


def filled(fields: np.dtype[Any], value: float = 0.0, **values: Any) -> Array:
    """Return a structured array (1,) of one record, for a compiled function to take its element 0.

    Parameters
    ----------
    fields : type of the record
    value : of all numbers that are not whole; whole ones and flags are 0
    values : by name, in place of it

    Examples
    --------
    >>> filled(record({"speed_mps": float, "n": int}), speed_mps=2.0)[0].item()
    (2.0, 0)
    """
    one = np.zeros(1, fields)
    parts = [one] if value != 0.0 else []
    for part in parts:
        if part.dtype.names is not None:
            parts += [part[name] for name in part.dtype.names]
        elif part.dtype.kind == "f":
            part[...] = value
    for name, given in values.items():
        one[name] = given
    return one


def is_finite(array: Array) -> bool:
    """Return whether all numbers of a structured array are finite.

    Examples
    --------
    >>> is_finite(filled(record({"speed_mps": float, "n": int}))), is_finite(filled(record({"x_m": float}), np.nan))
    (True, False)
    """
    if array.dtype.names is None:
        return bool(np.isfinite(array).all())
    return all(is_finite(array[name]) for name in array.dtype.names)
