"""The maps from which refinement starts: one module per way to find one."""

from jaxsmw.initial_maps.initial_map import INITIAL_MAPS, InitialMap, initial_map

__all__ = ["INITIAL_MAPS", "InitialMap", "initial_map"]
