"""The methods that `jaxsmw benchmark` compares with each other.

`base` defines the interface of a method, and `registry` lists the methods by name. The docstring of each
other module names the publication of its methods and the settings that the benchmark uses.
"""
