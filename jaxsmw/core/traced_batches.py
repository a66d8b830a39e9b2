"""Functions that `jax.vmap` calls in a loop on CPUs, and as one batch on accelerators.

On a CPU, a batch is not faster than its pairs: the arrays of all pairs do not fit into the cache, and
iterations go on until the slowest pair is done. A loop over the pairs avoids both.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import PyTree

from jaxsmw.core.arrays import Array

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")
Flat = Callable[..., Sequence[Array]]
"""A function that takes arrays and returns several arrays."""


def one_by_one(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Compile a function, and let `jax.vmap` call it in a loop on CPUs and as one batch on accelerators.

    Arguments and results are pytrees. Leaves that are not arrays are constants. The function keeps its
    derivatives, of both modes and of any order, and batches of derivatives are loops as well. If a batch can
    be divided among several devices, each step of the loop computes one pair per device.
    """
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*arguments: Parameters.args, **options: Parameters.kwargs) -> Returned:
        arrays, constants = eqx.partition((arguments, options), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)

        def of_leaves(*leaves: Array) -> Returned:
            arguments, options = eqx.combine(jax.tree.unflatten(structure, leaves), constants)
            return compiled(*arguments, **options)

        program, shapes = jax.make_jaxpr(of_leaves, return_shape=True)(*leaves)
        outputs = _differentiable(_with_constants(program))(*program.consts, *leaves)
        return jax.tree.unflatten(jax.tree.structure(shapes), outputs)

    return call


def _with_constants(program: ClosedJaxpr) -> Flat:
    """Return the function of a program, whose first arguments are the arrays that it closes over."""
    number = len(program.consts)
    return lambda *arrays: jaxpr_as_fun(ClosedJaxpr(program.jaxpr, arrays[:number]))(*arrays[number:])


def _differentiable(function: Flat) -> Flat:
    """Return the function with a loop for batches and with derivatives, which have loops as well."""
    looped = in_loop(function)
    call = jax.custom_jvp(lambda *arrays: looped(*arrays))

    def derivative(
        primals: Sequence[Array], tangents: Sequence[Any]
    ) -> tuple[Sequence[Array], Sequence[Any]]:
        moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]
        programs: list[ClosedJaxpr] = []

        def linearized(*arrays: Array) -> Sequence[Array]:
            """Return the outputs, and the arrays that their linear part needs."""

            def of_moving(*moved: Array) -> Sequence[Array]:
                replaced = dict(zip(moving, moved, strict=True))
                return function(*(replaced.get(i, array) for i, array in enumerate(arrays)))

            outputs, push = jax.linearize(of_moving, *(arrays[i] for i in moving))

            def push_inexact(*tangents: Array) -> Sequence[Array]:
                return [t for t, output in zip(push(*tangents), outputs, strict=True) if _is_inexact(output)]

            programs[:] = [jax.make_jaxpr(push_inexact)(*(arrays[i] for i in moving))]
            return [*outputs, *programs[0].consts]

        results = _differentiable(linearized)(*primals)
        number = len(results) - len(programs[0].consts)
        outputs, constants = results[:number], results[number:]
        pushed = iter(_linear(_with_constants(programs[0]), constants, [tangents[i] for i in moving]))
        return outputs, [next(pushed) if _is_inexact(output) else _no_tangent(output) for output in outputs]

    call.defjvp(derivative, symbolic_zeros=True)
    return call


def _linear(function: Flat, constants: Sequence[Array], tangents: Sequence[Array]) -> Sequence[Array]:
    """Return `function(*constants, *tangents)`, which is linear in the tangents, with loops for batches.

    The linear function A and its transpose each have a rule for batches. They enter as the solution (t, A t)
    of the linear system `s = t, u - A s = 0`, because only `custom_linear_solve` allows both a rule for
    batches and a transpose.
    """

    def push(tangents: Sequence[Array]) -> Sequence[Array]:
        return function(*constants, *tangents)

    def pull(*arrays: Array) -> Sequence[Array]:
        constants, changes = arrays[: -len(outputs)], arrays[-len(outputs) :]
        transposed = jax.linear_transpose(lambda *t: function(*constants, *t), *tangent_shapes)
        return transposed(list(changes))

    tangent_shapes = [jax.ShapeDtypeStruct(tangent.shape, tangent.dtype) for tangent in tangents]
    outputs = jax.eval_shape(push, tangents)
    if not outputs:
        return outputs
    push_in_loop, pull_in_loop = in_loop(function), in_loop(pull)
    # JAX transposes the solution only if the whole right side is linear in the tangents, also its zeros.
    zero = jnp.sum(tangents[0].reshape(-1)[:0])
    zeros = [jnp.broadcast_to(zero.astype(output.dtype), output.shape) for output in outputs]
    _, pushed = lax.custom_linear_solve(
        lambda pair: (pair[0], jax.tree.map(jnp.subtract, pair[1], push(pair[0]))),
        (list(tangents), zeros),
        lambda _, pair: (pair[0], jax.tree.map(jnp.add, pair[1], push_in_loop(*constants, *pair[0]))),
        lambda _, pair: (jax.tree.map(jnp.add, pair[0], list(pull_in_loop(*constants, *pair[1]))), pair[1]),
    )
    return pushed


def _is_inexact(array: Array) -> bool:
    return jnp.issubdtype(array.dtype, jnp.inexact)


def _no_tangent(array: Array) -> np.ndarray:
    return np.zeros(array.shape, jax.dtypes.float0)


def in_loop(function: Callable[..., Any], *, on_all_devices: bool = True) -> Callable[..., Any]:
    """Return a function of arrays that `jax.vmap` calls in a loop on CPUs, without reverse-mode derivatives.

    If `on_all_devices` is True, each step of the loop computes one entry of the batch per device.
    """
    looped = jax.custom_batching.custom_vmap(function)

    @looped.def_vmap
    def batch(size: int, batched: list[bool], *arrays: Array) -> tuple[Any, PyTree[bool]]:
        axes = [0 if has_axis else None for has_axis in batched]
        together = jax.vmap(function, axes)
        devices = jax.device_count("cpu") if on_all_devices else 1

        def in_steps(*arrays: Array) -> Any:
            if devices == 1 or size % devices:
                return _loop(looped, axes, arrays)
            if size == devices:
                return together(*arrays)
            # A device has neighbouring entries of the batch, so the compiler divides the second axis of the
            # steps among the devices.
            steps = [
                array if axis is None else array.reshape(devices, -1, *array.shape[1:]).swapaxes(0, 1)
                for array, axis in zip(arrays, axes, strict=True)
            ]
            outputs = _loop(together, axes, steps)
            return jax.tree.map(lambda leaf: leaf.swapaxes(0, 1).reshape(size, *leaf.shape[2:]), outputs)

        outputs = lax.platform_dependent(*arrays, cpu=in_steps, default=together)
        return outputs, jax.tree.map(lambda _: True, outputs)

    return looped


def _loop(function: Callable[..., Any], axes: Sequence[int | None], arrays: Sequence[Array]) -> Any:
    """Call the function for each entry of the arrays that have an axis, one after the other."""

    places = [place for place, axis in enumerate(axes) if axis is not None]

    def of_entries(entries: Sequence[Array]) -> Any:
        arguments = list(arrays)
        for place, entry in zip(places, entries, strict=True):
            arguments[place] = entry
        return function(*arguments)

    return lax.map(of_entries, [arrays[place] for place in places])
