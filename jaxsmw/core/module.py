"""Frozen dataclasses that JAX treats as pytrees."""

from __future__ import annotations

import abc
import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from threading import Lock
from typing import Any, ParamSpec, TypeVar, dataclass_transform

import numpy as np

from jaxsmw.core.arrays import is_array, is_tracer

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def field(*, static: bool = False, converter: Callable[[Any], Any] | None = None, **options: Any) -> Any:
    """Declare a field of a `Module`.

    **Arguments:**

    - `static`: whether the field is a constant for JAX, and not a part of the pytree. Its values must be
      hashable.
    - `converter`: a function that the constructor applies to the given value or the default.
    - `options`: see `dataclasses.field`.
    """
    return dataclasses.field(metadata={"static": static, "converter": converter}, **options)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field, dataclasses.field))
class Module(abc.ABC):  # noqa: B024 (a base of abstract classes)
    """The base class of the classes of the core: frozen dataclasses, which are pytrees of JAX.

    `equinox.Module` is the model, and the functions of Equinox work with these classes as well. Unlike with
    Equinox, JAX need not be imported: subclasses become pytrees when JAX is imported. If a subclass has a
    method `__check_init__`, the constructor calls the methods of this name of all classes. A subclass cannot
    have an `__init__` or `__post_init__` of its own. Two modules are equal if they have equal fields.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if not vars(cls).keys().isdisjoint(("__init__", "__post_init__")):
            raise TypeError(
                f"{cls.__name__} defines __init__ or __post_init__, which would skip the checks of its base "
                "class: give its fields a converter (field), and check them in __check_init__"
            )
        dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
        for one in _fields(cls):
            if one.metadata.get("converter") is not None:
                cls.__init__.__annotations__[one.name] = Any  # the constructor accepts what can be converted
        _register_now_or_later(cls)

    def __post_init__(self) -> None:
        for one in _fields(type(self)):
            if (convert := one.metadata.get("converter")) is not None:
                object.__setattr__(self, one.name, convert(getattr(self, one.name)))
        for kind in type(self).__mro__:
            if "__check_init__" in vars(kind):
                vars(kind)["__check_init__"](self)

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and all(
            _equal(mine, theirs) for mine, theirs in zip(_values(self), _values(other), strict=True)
        )

    def __hash__(self) -> int:
        return hash(type(self))

    def __repr__(self) -> str:
        names = [one.name for one in _fields(type(self))]
        shown = (f"{name}={_shown(value)}" for name, value in zip(names, _values(self), strict=True))
        return f"{type(self).__name__}({', '.join(shown)})"


def _fields(kind: Any) -> tuple[dataclasses.Field, ...]:
    return dataclasses.fields(kind)


def _dynamic(kind: type) -> list[dataclasses.Field]:
    """Return the fields of a class that are part of the pytree."""
    return [one for one in _fields(kind) if not one.metadata.get("static")]


def _values(module: Any) -> Iterator[Any]:
    return (getattr(module, one.name) for one in _fields(type(module)))


def leaves(tree: Any) -> Iterator[Any]:
    """Yield the leaves of a tree of modules and tuples, as `jax.tree.leaves` does."""
    if isinstance(tree, Module):
        for one in _dynamic(type(tree)):
            yield from leaves(getattr(tree, one.name))
    elif isinstance(tree, tuple):
        for child in tree:
            yield from leaves(child)
    elif hasattr(tree, "dtype") or isinstance(tree, int | float):
        yield tree
    elif tree is not None:
        # Users' states can contain other trees, which JAX knows.
        import jax

        yield from jax.tree.leaves(tree)


def _equal(mine: Any, theirs: Any) -> bool:
    if is_array(mine) or is_array(theirs):
        both = is_array(mine) and is_array(theirs) and mine.dtype == theirs.dtype
        return both and np.array_equal(mine, theirs)
    if isinstance(mine, tuple) and isinstance(theirs, tuple):
        return len(mine) == len(theirs) and all(map(_equal, mine, theirs))
    return bool(mine == theirs)


def _shown(value: Any) -> str:
    """Return the text of a value; of an array, only the type and the shape."""
    return f"{value.dtype}{list(value.shape)}" if is_array(value) else repr(value)


def jitted(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Decorate a function, which JAX compiles at its first call by `equinox.filter_jit`.

    `jax.vmap` calls the function in a loop on CPUs; see `jaxsmw.core.traced_batches.one_by_one`.
    """

    @functools.cache
    def compiled() -> Any:
        import equinox as eqx

        from jaxsmw.core.traced_batches import one_by_one

        return eqx.filter_jit(one_by_one(function))

    @functools.wraps(function)
    def call(*arguments: Parameters.args, **options: Parameters.kwargs) -> Returned:
        return compiled()(*arguments, **options)

    return call


def looped(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Decorate a function that computes NumPy arrays at once, and that `jax.vmap` calls in a loop on CPUs."""
    compiled = jitted(function)

    @functools.wraps(function)
    def call(*arguments: Parameters.args, **options: Parameters.kwargs) -> Returned:
        traced = any(map(is_tracer, leaves((*arguments, *options.values()))))
        return (compiled if traced else function)(*arguments, **options)

    return call


# The classes that wait for the import of JAX, and the lock under which they are listed and registered.
_waiting: list[type] = []
_lock = Lock()


def _register_now_or_later(kind: type) -> None:
    with _lock:
        if "jax" not in sys.modules:
            _waiting.append(kind)
            return
    import jax  # If another thread is importing JAX, this statement waits for it.

    _register_class(jax.tree_util, kind)


class _ImportOfJax(MetaPathFinder):
    """Registers the waiting classes at the end of the import of JAX."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name != "jax":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: Any) -> None:
                execute(module)
                with _lock:
                    for kind in _waiting:
                        _register_class(module.tree_util, kind)
                    _waiting.clear()

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


if "jax" not in sys.modules:
    sys.meta_path.insert(0, _ImportOfJax())


def _register_class(tree_util: Any, kind: type) -> None:
    names = [one.name for one in _dynamic(kind)]
    constants = [one.name for one in _fields(kind) if one.name not in names]

    def flatten(module: Any) -> tuple[tuple, tuple]:
        return (
            tuple(getattr(module, name) for name in names),
            tuple(getattr(module, name) for name in constants),
        )

    def flatten_with_keys(module: Any) -> tuple[tuple, tuple]:
        children, aside = flatten(module)
        keys = map(tree_util.GetAttrKey, names)
        return tuple(zip(keys, children, strict=True)), aside

    def unflatten(aside: tuple, children: tuple) -> object:
        # The constructor would convert and check placeholders of JAX.
        module: Any = object.__new__(kind)
        for name, value in zip((*names, *constants), (*children, *aside), strict=True):
            object.__setattr__(module, name, value)
        return module

    tree_util.register_pytree_with_keys(kind, flatten_with_keys, unflatten, flatten)
