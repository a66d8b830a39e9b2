"""The methods that `jaxsmw benchmark` compares with each other, one file for each.

- `base`: what a method is given (`MethodInput`) and what a method is (`Method`).
- `initial_map`, `presets`, `published_maps`: no refinement, this library's own methods, and maps in files.
- `spectral_icp`, `zoomout`, `bcicp`, `cpd`, `partial_functional_maps`: methods by other authors, rewritten
  here.
- `peers`: programs of other libraries, where they are installed.
- `registry`: the name of each method on the command line and in results.

The docstring at the top of each file names the text that the method was written from and the settings used.
"""
