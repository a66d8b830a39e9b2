"""The matrix product that the core uses everywhere."""

from functools import partial

import jax.numpy as jnp
from jax import lax

# By default, GPUs multiply float32 matrices in lower precision. Distances and differences of squares would
# then lose digits, and singular systems would look regular.
product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
