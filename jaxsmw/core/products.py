"""The one matrix product of the core."""

from functools import partial

import jax.numpy as jnp
from jax import lax

# GPUs would otherwise multiply in less than float32: rankings and differences of squares would lose digits,
# and singular systems pass for regular ones.
product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
