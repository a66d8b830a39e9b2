"""Traced programs on disk. A later process loads such a program instead of tracing the function again."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export
from jaxtyping import PyTree

from jaxsmw.runtime.cache import cached
from jaxsmw.runtime.provenance import measured_code, versions

# Objects of these packages can be described by the names of their classes, because `traced` knows the code of
# the first package and the version of the second package.
_PACKAGES = ("jaxsmw", "equinox")
# These types are stored as they are.
_VALUES = (type(None), bool, int, float, str)


class UndescribedError(Exception):
    """A pytree contains an object that `describe` cannot describe, such as an object of the user's code."""


class TracedProgram(NamedTuple):
    """A traced function of arrays.

    **Attributes:**

    - `exported`: the function, which takes and returns a list of arrays.
    - `structure`: the structure of the result, for `rebuild`.
    """

    exported: export.Exported
    structure: Any


def traced(function: Callable, structure: Any, shapes: Sequence[jax.ShapeDtypeStruct]) -> TracedProgram:
    """Trace a function for arguments of given structure and shapes, or load the program from the cache.

    The cache is `jaxsmw.runtime.cache`. The key of a program contains the name of the function, the code of
    jaxsmw, the versions of the packages, the settings of JAX, the structure and the shapes.

    **Arguments:**

    - `function`: a function of jaxsmw that JAX can trace.
    - `structure`: the structure of the pair of positional arguments (a tuple) and keyword arguments (a
      dictionary); see `describe`.
    - `shapes`: the shape and the type of each array in the arguments.

    **Returns:** The `TracedProgram`.

    **Raises:** `UndescribedError` if `function` or its result cannot be described. All errors that `function`
    raises.
    """

    def trace() -> dict[str, np.ndarray]:
        found: list[Any] = []

        def of_arrays(*arrays: jax.Array) -> list[jax.Array]:
            positional, named = rebuild(structure, arrays)
            described, results = describe(function(*positional, **named))
            found.append(described)
            return results

        exported = export.export(jax.jit(of_arrays))(*shapes)
        return {
            "exported": np.frombuffer(exported.serialize(), np.uint8),
            "structure": np.array(json.dumps(found[-1])),
        }

    sizes = [(shape.shape, str(shape.dtype)) for shape in shapes]
    key = json.dumps([_name(function), _environment(), structure, sizes])
    entry = cached("traced-program", [key], trace)
    exported = export.deserialize(bytearray(entry["exported"].tobytes()))
    return TracedProgram(exported, json.loads(str(entry["structure"])))


def _environment() -> list[Any]:
    """Return the software and the settings of JAX, on which a traced program depends."""
    settings = {name: str(value) for name, value in jax.config.values.items() if "cache" not in name}
    # The dictionary `values` does not contain the setting of the present thread.
    settings["jax_enable_x64"] = str(jax.config.read("jax_enable_x64"))
    return [_software(), sorted(settings.items())]


@cache
def _software() -> str:
    """Return a hash of the versions, and of all Python files that can change a traced program."""
    digest = hashlib.sha256(json.dumps(versions()).encode())
    for path in measured_code():
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def describe(tree: PyTree) -> tuple[Any, list[Any]]:
    """Divide a pytree into its structure and its arrays.

    **Arguments:**

    - `tree`: a pytree of tuples, lists, dictionaries, named tuples, dataclasses, arrays, numbers, texts, and
      classes and functions. All classes and functions must be defined in modules of jaxsmw or equinox.

    **Returns:** The structure, which consists of lists, texts and numbers that JSON can store, and the list
    of arrays.

    **Raises:** `UndescribedError` if the pytree contains any other object.
    """
    arrays: list[Any] = []

    def described(value: Any) -> Any:
        if isinstance(value, jax.Array | np.ndarray):
            arrays.append(value)
            return ["array"]
        if type(value) in _VALUES:
            return ["value", value]
        if type(value) in (tuple, list):
            return [type(value).__name__, *map(described, value)]
        if type(value) is dict and all(type(name) is str for name in value):
            names = sorted(value)
            return ["dict", names, *(described(value[name]) for name in names)]
        if isinstance(value, type | FunctionType):
            return ["name", _name(value)]
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            return ["named tuple", _name(type(value)), *map(described, value)]
        if dataclasses.is_dataclass(value):
            names = [field.name for field in dataclasses.fields(value) if hasattr(value, field.name)]
            return ["dataclass", _name(type(value)), names, *(described(getattr(value, n)) for n in names)]
        raise UndescribedError(f"{value!r} cannot be described")

    return described(tree), arrays


def rebuild(structure: Any, arrays: Sequence[Any]) -> Any:
    """Return the pytree that `describe` divided into a structure and arrays.

    Dataclasses are made without their `__init__`, because their fields have been checked before.
    """
    remaining = iter(arrays)

    def rebuilt(part: Any) -> Any:
        kind, *content = part
        if kind == "array":
            return next(remaining)
        if kind == "value":
            return content[0]
        if kind in ("tuple", "list"):
            values = map(rebuilt, content)
            return tuple(values) if kind == "tuple" else list(values)
        if kind == "dict":
            return dict(zip(content[0], map(rebuilt, content[1:]), strict=True))
        known = _known(content[0])
        if kind == "name":
            return known
        if kind == "named tuple":
            return known(*map(rebuilt, content[1:]))
        made = object.__new__(known)
        for name, value in zip(content[1], content[2:], strict=True):
            object.__setattr__(made, name, rebuilt(value))
        return made

    return rebuilt(structure)


def _name(known: type | Callable) -> str:
    """Return the name of a class or function, as the module and the name in the module.

    **Raises:** `UndescribedError` if the class or function has no such name in jaxsmw or equinox.
    """
    module, name = getattr(known, "__module__", ""), getattr(known, "__qualname__", "")
    full = f"{module}:{name}"
    if module.partition(".")[0] not in _PACKAGES or "<locals>" in name or _known(full) is not known:
        raise UndescribedError(f"{known!r} has no name in {' or '.join(_PACKAGES)}")
    return full


@cache
def _known(full: str) -> Any:
    """Return the class or function with a name that `_name` returned; None if there is none."""
    module, _, name = full.partition(":")
    found: Any = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found
