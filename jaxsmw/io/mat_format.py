"""Checks how much memory the contents of a `.mat` file take, before SciPy reads the file.

A compressed variable can unpack to a thousand times its size. A cell array can declare a billion cells that
the file does not contain. SciPy allocates memory for all unpacked bytes and for all declared cells. Therefore
this module unpacks the variables itself, up to a limit. It also adds up the sizes of all arrays, including
nested arrays.

The format is described in The MathWorks, "MAT-File Format", level 5.
"""

from __future__ import annotations

import io
import math
import struct
import zlib

from scipy.io.matlab import matfile_version

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import largest_contents

_MATRIX, _COMPRESSED = 14, 15
# The number of bytes per number for some data types. All other data types have 1 byte per number.
_BYTES_OF_NUMBER = {3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 17: 2, 18: 4}
# The array classes cell, struct and object.
_CONTAINERS = 1, 2, 3

# Each array adds this number of bytes to the counted memory, even if it is empty. The limit on the memory
# therefore also limits the number of arrays. SciPy takes at least 10 microseconds per array, and reads a few
# KiB of numbers in this time.
_BYTES_PER_ARRAY = 4096
# The largest accepted size of all field names of a struct, in bytes. The limit allows 1000 fields with names
# of 64 bytes. The structs of shapes have about ten fields.
_LONGEST_NAMES = 64 * 1000


def unpacked(data: bytes) -> bytes:
    """Unpack all variables of a `.mat` file and check their sizes.

    **Returns:** The contents of an equivalent file in which no variable is compressed.

    **Raises:** `InputError` for format 7.3, and for contents that are larger than both 1 GiB and four times
    the size of the file (`jaxsmw.runtime.files.largest_contents`). The message does not name the file.
    `ValueError`, `struct.error` or `zlib.error` if the file is damaged.
    """
    if data.startswith((b"MATLAB 7.3", b"\x89HDF")) or matfile_version(io.BytesIO(data))[0] == 2:
        raise InputError(
            "is in MATLAB's format 7.3, which is not supported: save it in MATLAB with save(..., '-v7')."
        )
    if matfile_version(io.BytesIO(data))[0] == 0:
        return data  # level 4 has neither compression nor nested arrays
    order = "<" if data[126:128] == b"IM" else ">"
    remaining = largest_contents(len(data))
    elements, position = [data[:128]], 128
    while position < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, position)
        element = data[position : position + 8 + size]
        if len(element) < 8 + size:
            raise ValueError("a variable ends early")
        position += len(element)
        if kind == _COMPRESSED:
            element = _inflated(element[8:], order, remaining)
        remaining -= _memory(element, order, remaining)
        elements.append(element)
    return b"".join(elements)


def _inflated(data: bytes, order: str, limit: int) -> bytes:
    """Unpack a variable to the size that its tag declares.

    **Raises:** `InputError` if the declared size is above `limit` bytes.
    """
    stream = zlib.decompressobj()
    tag = stream.decompress(data, 8)
    _, size = struct.unpack(f"{order}II", tag)
    if size > limit:
        raise _too_large()
    # `decompress` would treat a size of 0 as no limit.
    contents = stream.decompress(stream.unconsumed_tail, size) if size else b""
    if len(contents) < size:
        raise ValueError("a compressed variable ends early")
    return tag + contents


def _memory(variable: bytes, order: str, limit: int) -> int:
    """Return the memory in bytes that a variable takes if every number becomes a float64.

    **Raises:** `InputError` if the memory is above `limit` bytes.
    """
    memory, pending = 0, [(0, len(variable), False)]
    while pending:
        position, stop, in_container = pending.pop()
        while position + 8 <= stop:
            kind, size = struct.unpack_from(f"{order}II", variable, position)
            if kind >> 16:  # the tag of a small element also contains the element's data of up to 4 bytes
                position += 8
                continue
            start, end = position + 8, position + 8 + size
            if end > stop:
                raise ValueError("an array ends early")
            if kind == _MATRIX:
                memory += _BYTES_PER_ARRAY
                if size:
                    pending.append((start, end, _is_container(variable, start, size, order)))
            elif in_container and size > _LONGEST_NAMES:
                raise ValueError("a struct has too many fields")
            else:
                memory += 8 * (size // _BYTES_OF_NUMBER.get(kind, 1))
            if memory > limit:
                raise _too_large()
            position = end + -size % 8
    return memory


def _is_container(variable: bytes, start: int, size: int, order: str) -> bool:
    """Return whether an array is a cell, struct or object array.

    **Raises:** `ValueError` if the array declares more elements than it contains.
    """
    kind, length, flags, _, _, bytes_of_shape = struct.unpack_from(f"{order}6I", variable, start)
    if (kind, length) != (6, 8):
        raise ValueError("an array does not begin with its flags")
    if flags & 0xFF not in _CONTAINERS:
        return False
    shape = struct.unpack_from(f"{order}{min(bytes_of_shape, size) // 4}i", variable, start + 24)
    # Every element takes at least the 8 bytes of its tag.
    if min(shape) < 0 or math.prod(shape) > size // 8:
        raise ValueError("a cell array declares more cells than it contains")
    return True


def _too_large() -> InputError:
    return InputError(
        "would take more than 1 GiB of memory and more than four times the size of the file: save only the "
        "variables that are needed."
    )
