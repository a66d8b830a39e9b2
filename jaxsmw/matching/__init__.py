"""What a match is made of. No module imports one that stands below it, so the list reads from the top.

- `pair`: two meshes, and the units in which they are compared.
- `settings`, `stages`: what refines a map, and presets that say in which order.
- `spectral_pair`: the spectra of a pair, on which stages run.
- `shape`: the spectrum and samples of one shape.
- `descriptors`: descriptors of several shapes in common axes.
- `preparation`: spectra, samples and descriptors of both shapes.
- `outcome`: what stages start from, and what they leave.
- `starts`: initial maps.
- `executor`: runs stages on one pair or on many.
- `judge`: measures of maps without ground truth.
- `search`: the search for the right map, its judge, and the trimming of partial shapes.
- `correspondence`: the result, for the vertices of the given meshes.
- `template`: joins the matches of two partial shapes with a full shape.
- `advice`: what `match` tells about a map that may be wrong.
- `match`: all of these in one function, in the order in which they run.
"""
