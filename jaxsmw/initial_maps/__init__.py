"""Initial maps, from which refinement begins."""

from jaxsmw.initial_maps.initial_map import INITIAL_MAPS, InitialMap, check_initial_map, initial_map

__all__ = ["INITIAL_MAPS", "InitialMap", "check_initial_map", "initial_map"]
