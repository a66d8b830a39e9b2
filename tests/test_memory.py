"""Memory that the process has freed returns to the operating system."""

import platform
import re
from pathlib import Path

import pytest

from jaxsmw.runtime import memory

pytestmark = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other allocators than glibc's return memory by themselves"
)


def resident() -> int:
    """Return the memory of this process in MiB."""
    (kilobytes,) = re.findall(r"VmRSS:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(kilobytes) // 1024


def test_free_memory_is_returned_after_the_interval(monkeypatch):
    blocks = [bytes([number % 255 + 1]) * 60_000 for number in range(5000)]  # 286 MiB
    last = blocks[-1]  # glibc keeps all freed memory below this block
    full = resident()
    del blocks
    kept = resident()
    assert kept > full - 50
    monkeypatch.setattr(memory, "_previous", memory.time.monotonic())
    memory.return_free_memory()
    assert resident() > kept - 50
    monkeypatch.setattr(memory, "_previous", memory.time.monotonic() - 60)
    memory.return_free_memory()
    assert resident() < kept - 200
    assert len(last) == 60_000
