"""Solutions: methods that compute a functional map from a pointwise map.

The refiner `WaveletPreservation` uses a `Solution` in every iteration. The solutions minimise the
wavelet-preservation energy exactly or approximately. `RegularizedLeastSquares` minimises a sum of this energy
and other terms.
"""
