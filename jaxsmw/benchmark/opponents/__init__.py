"""The methods that `jaxsmw benchmark` compares with each other.

The modules of this package are:

- `base`: the input of a method (`MethodInput`) and the interface of a method (`Method`).
- `baselines`: the initial map without refinement, this library's own methods, spectral ICP and ZoomOut, and
  methods that read the maps of other programs from files.
- `smooth_shells`, `cpd`, `partial_functional_maps`: methods by other authors, reimplemented here.
- `peers`: methods of other libraries, if these are installed.
- `registry`: the name of each method on the command line and in results.

The docstring of each module names the publication of its methods and the settings that the benchmark uses.
"""
