"""The matrix product that the core uses everywhere."""

from functools import partial

import jax.numpy as jnp
from jax import lax

# By default, GPUs multiply float32 matrices in lower precision. Distances would then lose digits, and
# rounding errors could hide that a linear system is singular.
product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
