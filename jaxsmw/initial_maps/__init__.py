"""The initial maps, from which refinement begins. Each kind of initial map has its own module."""

from jaxsmw.initial_maps.initial_map import INITIAL_MAPS, InitialMap, initial_map

__all__ = ["INITIAL_MAPS", "InitialMap", "initial_map"]
