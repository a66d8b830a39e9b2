"""What a match is made of, in the order in which it runs. (`preparation` imports `stages` and `executor`.)

- `pair`: two meshes, and the units in which they are compared.
- `preparation`: spectra, samples and descriptors of both shapes.
- `starts`: initial maps.
- `stages`: what refines a map, and presets that say in which order.
- `executor`: runs stages, padded and compiled, for one start or many.
- `judge`: whether a map looks right, and which of two is better.
- `search`: mirror images, alternative maps, repair and trimming.
- `correspondence`: the result, for the vertices of the given meshes.
- `match`: all of these in one function.
"""
