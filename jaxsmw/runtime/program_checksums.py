"""Checks the compiled programs that JAX has stored on disk.

JAX does not write programs atomically, so a killed process can leave half a program behind. JAX also never
replaces a damaged program: it would warn and compile the program again in every process. With some kinds of
compression, JAX would run a damaged program.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write

CHECKSUMS = "checksums.json"
"""The name of the file that contains the checksums, in the directory of the programs."""

_ZSTANDARD = b"\x28\xb5\x2f\xfd"


def remove_damaged_programs(directory: Path) -> None:
    """Remove damaged programs from the directory in which JAX stores programs.

    A program is damaged if it differs from its recorded checksum, or if a new program cannot be unpacked.
    Other processes can use the directory at the same time. Files that cannot be read or removed stay.
    """
    record = directory / CHECKSUMS
    recorded, whole = _recorded(record), {}
    for path in sorted(directory.glob("*-cache")):
        with suppress(OSError):
            contents = path.read_bytes()
            checksum = hashlib.sha256(contents).hexdigest()
            expected = recorded.get(path.name)
            if checksum == expected or (expected is None and _can_be_unpacked(contents)):
                whole[path.name] = checksum
            else:
                path.unlink()
    if whole != recorded:
        # If the record cannot be written, all programs are unpacked again next time.
        with suppress(InputError), atomic_write(record) as temporary:
            temporary.write_text(json.dumps(whole, indent=1), "utf-8")


def _recorded(record: Path) -> dict[str, str]:
    """Return the recorded checksums. The dictionary is empty if the record is missing or damaged."""
    with suppress(OSError, ValueError):
        recorded = json.loads(record.read_text("utf-8"))
        if isinstance(recorded, dict):
            return recorded
    return {}


def _can_be_unpacked(contents: bytes) -> bool:
    # JAX compresses programs with zstandard if it is installed, and with zlib otherwise.
    if not contents.startswith(_ZSTANDARD):
        with suppress(zlib.error):
            return bool(zlib.decompress(contents))
        return False
    for name in ("compression.zstd", "zstandard"):
        with suppress(ImportError):
            module = import_module(name)
            with suppress(Exception):  # both modules have exceptions of their own
                return bool(module.decompress(contents))
            return False
    return True  # without these modules, JAX does not read the program
