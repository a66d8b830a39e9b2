"""Traced programs on disk. A later process loads such a program instead of tracing the function again."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
from collections.abc import Callable, Sequence
from functools import cache
from types import FunctionType
from typing import Any

import jax
import numpy as np
from jax import export
from jaxtyping import PyTree

from jaxsmw.runtime.cache import cached
from jaxsmw.runtime.provenance import LIBRARY, measured_code, versions

# Objects of these packages can be described by the names of their classes, because `traced` knows the code of
# the first package and the version of the second package.
_PACKAGES = ("jaxsmw", "equinox")
# The methods of a benchmark are traced in each process, so that changes of them need no other programs.
_NEVER_STORED = "jaxsmw.benchmark"
# These types are stored as they are.
_VALUES = (type(None), bool, int, float, str)

Structure = Any
"""The structure of a pytree without its arrays, as lists, texts and numbers that JSON can store."""


class UndescribedError(Exception):
    """A pytree contains an object that `flatten` cannot describe, such as an object of the user's code."""


def traced(
    function: Callable, structure: Structure, shapes: Sequence[jax.ShapeDtypeStruct]
) -> tuple[export.Exported, Structure]:
    """Trace a function for arguments of given structure and shapes, or load the program from the cache.

    **Arguments:**

    - `function`: a function of jaxsmw that JAX can trace.
    - `structure`: the structure of the pair of positional arguments (a tuple) and keyword arguments (a
      dictionary); see `flatten`.
    - `shapes`: the shape and the type of each array in the arguments.

    **Returns:** The function from a list of arrays to a list of arrays, and the structure of its result.

    **Raises:** `UndescribedError` if `function` or its result cannot be described. All errors that `function`
    raises.
    """

    def trace() -> dict[str, np.ndarray]:
        of_result: list[Structure] = []

        def of_arrays(*arrays: jax.Array) -> list[jax.Array | np.ndarray]:
            positional, named = rebuild(structure, arrays)
            described, results = flatten(function(*positional, **named))
            of_result.append(described)
            return results

        exported = export.export(jax.jit(of_arrays))(*shapes)
        return {
            "exported": np.frombuffer(exported.serialize(), np.uint8),
            "structure": np.array(json.dumps(of_result[-1])),
        }

    settings = {name: str(value) for name, value in jax.config.values.items() if "cache" not in name}
    # The dictionary `values` does not contain the setting of the present thread.
    settings["jax_enable_x64"] = str(jax.config.read("jax_enable_x64"))
    sizes = [(shape.shape, str(shape.dtype)) for shape in shapes]
    key = json.dumps([_name(function), _software(), sorted(settings.items()), structure, sizes])
    entry = cached("traced-program", [key], trace)
    exported = export.deserialize(bytearray(entry["exported"].tobytes()))
    return exported, json.loads(str(entry["structure"]))


@cache
def _software() -> str:
    """Return a hash of the versions, and of all Python files that can change a traced program.

    Comments count too, because parsing the files would take more than a second.
    """
    digest = hashlib.sha256(json.dumps(versions()).encode())
    for path in measured_code():
        if path.relative_to(LIBRARY).parts[0] != "benchmark":
            content = path.read_bytes()
            digest.update(f"{path.name} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def flatten(tree: PyTree) -> tuple[Structure, list[jax.Array | np.ndarray]]:
    """Divide a pytree into its structure and its arrays.

    **Raises:** `UndescribedError` if the pytree contains an object other than tuples, lists, dictionaries,
    arrays, numbers, texts, and named tuples, dataclasses, classes and functions of jaxsmw or equinox.
    """
    arrays: list[jax.Array | np.ndarray] = []

    def described(value: Any) -> Structure:
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


def rebuild(structure: Structure, arrays: Sequence[Any]) -> Any:
    """Return the pytree that `flatten` divided into a structure and arrays."""
    remaining = iter(arrays)

    def rebuilt(part: Structure) -> Any:
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
        class_or_function = _named(content[0])
        if kind == "name":
            return class_or_function
        if kind == "named tuple":
            return class_or_function(*map(rebuilt, content[1:]))
        made = object.__new__(
            class_or_function
        )  # without `__init__`, because the fields have been checked before
        for name, value in zip(content[1], content[2:], strict=True):
            object.__setattr__(made, name, rebuilt(value))
        return made

    return rebuilt(structure)


def _name(value: type | Callable) -> str:
    """Return the module and the name of a class or function; `UndescribedError` if they do not lead to it."""
    module, name = getattr(value, "__module__", ""), getattr(value, "__qualname__", "")
    full = f"{module}:{name}"
    if (
        module.partition(".")[0] not in _PACKAGES
        or module.startswith(_NEVER_STORED)
        or "<locals>" in name
        or _named(full) is not value
    ):
        raise UndescribedError(f"{value!r} has no name in {' or '.join(_PACKAGES)}")
    return full


@cache
def _named(full: str) -> Any:
    """Return the class or function with a name that `_name` returned; None if there is none."""
    module, _, name = full.partition(":")
    value: Any = importlib.import_module(module)
    for part in name.split("."):
        value = getattr(value, part, None)
    return value
