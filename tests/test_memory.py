"""Memory that the process no longer uses goes back to the system."""

import platform
import subprocess
import sys

import pytest

# The block that is allocated last is kept. It lies above all freed blocks, so that glibc keeps them as well.
SCRIPT = """
import re
from pathlib import Path
from jaxsmw.runtime.memory import release_freed_memory

def resident():
    return int(re.search(r"VmRSS:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024

blocks = [bytearray(b"x" * 60_000) for _ in range(2000)]
blocks = blocks[-1:]
freed = resident()
release_freed_memory()
print(freed - resident())
"""


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="only glibc can be asked to return freed memory"
)
def test_freed_memory_is_returned():
    released = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    ).stdout
    assert float(released) > 100  # MiB
