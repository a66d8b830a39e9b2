"""Initial maps, from which refinement begins."""

from jaxsmw.initial_maps.initial_map import INITIAL_MAPS, InitialMap, initial_map

__all__ = ["INITIAL_MAPS", "InitialMap", "initial_map"]
