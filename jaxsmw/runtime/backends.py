"""The choice between NumPy and JAX for the refinement of one pair."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

from jaxsmw.choices import Backend
from jaxsmw.errors import InputError

if TYPE_CHECKING:
    from jax import Device
else:
    Device = Any  # the class is in JAX, which need not be imported


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


def check_devices(devices: Sequence[Device] | None) -> None:
    """Raise `InputError` unless `devices` is None or contains JAX devices only, at least one."""
    if devices is None:
        return
    import jax

    checked = list(devices) if isinstance(devices, Iterable) else []
    if not checked or not all(isinstance(device, jax.Device) for device in checked):
        raise InputError(f"devices is {devices!r}: give at least one JAX device, or None for all devices.")
