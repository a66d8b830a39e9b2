"""The choice between NumPy and JAX for the refinement of one pair."""

from __future__ import annotations

import os
import sys
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Literal

from jaxsmw.choices import Backend


def chosen_backend(backend: Backend) -> Literal["numpy", "jax"]:
    """Return the backend that `"auto"` stands for: JAX if the machine has an accelerator, else NumPy.

    JAX is imported only if it is installed with the plugin of an accelerator.
    """
    if backend != "auto":
        return backend
    if "jax" not in sys.modules:
        if os.environ.get("JAX_PLATFORMS") == "cpu":
            return "numpy"
        if not (find_spec("jax_plugins") or find_spec("libtpu") or entry_points(group="jax_plugins")):
            return "numpy"
    import jax

    return "numpy" if jax.default_backend() == "cpu" else "jax"


def device() -> str:
    """Return the kind of device on which one pair is refined: `"cpu"`, or the name of an accelerator."""
    if chosen_backend("auto") == "numpy":
        return "cpu"
    import jax

    return jax.devices()[0].device_kind
