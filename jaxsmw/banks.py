"""Filter banks, warps of the eigenvalue axis, and frame bounds; see `docs/frames.md`."""

from jaxsmw.core.banks import *  # noqa: F403 (`__all__` lists the names)
from jaxsmw.core.banks import __all__ as __all__
