"""One module per format of mesh files. Each module parses and formats the bytes of a file."""
