"""Each worker uses one core, and the calling process does not change."""

import ast
import multiprocessing
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import pytest

from jaxsmw.runtime.workers import Workers, run_tasks

# NumPy and JAX are imported, and an array is made, before the worker runs any function of the library.
PROGRAM = """
import collections, os
from pathlib import Path
import jax, numpy
from jaxsmw.runtime.workers import Workers

ones = jax.numpy.ones((500, 500)) @ jax.numpy.ones((500, 500))

def look():
    from threadpoolctl import threadpool_info
    (ones @ ones).block_until_ready()
    threads = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    return {
        "pools": {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"},
        "XLA threads": threads.count("tf_XLAEigen"),
        "platform": jax.default_backend(),
        "flags": os.environ["XLA_FLAGS"].split(),
    }

if __name__ == "__main__":
    before = dict(os.environ)
    with Workers(2) as workers:
        found = [future.result() for future in [workers.submit(look) for _ in range(2)]]
    print((found, dict(os.environ) == before))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="only Linux lists the threads of a process")
def test_workers_have_one_thread_and_the_environment_does_not_change(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "PJRT_NPROC", "JAX_PLATFORMS")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    flags = ["--xla_cpu_use_fusion_emitters=false"] if jax.__version_info__[:2] == (0, 10) else []
    environment["XLA_FLAGS"] = " ".join(flags)
    done = subprocess.run(
        [sys.executable, program], env=environment, check=True, capture_output=True, text=True
    )
    found, unchanged = ast.literal_eval(done.stdout)
    assert unchanged
    for worker in found:
        assert worker["pools"] == {1} and worker["XLA threads"] == 1 and worker["platform"] == "cpu"
        assert worker["flags"] == [*flags, "--xla_cpu_multi_thread_eigen=false"]


def give_up(workers: Workers) -> None:
    with workers:
        workers.submit(time.sleep, 300)
        raise RuntimeError("given up")


def test_an_exception_ends_the_workers_and_no_other_process():
    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(300,))
    other.start()
    try:
        workers = Workers(1)
        process = workers.submit(os.getpid).result()
        with pytest.raises(RuntimeError, match="given up"):
            give_up(workers)
        assert not Path(f"/proc/{process}").exists()
        assert other.is_alive()
    finally:
        other.terminate()
        other.join()


def square(number: int) -> int:
    """Issues two equal warnings, then one that contains the number."""
    for text in ("the same", "the same", f"of {number}"):
        warnings.warn(text, stacklevel=1)
    return number**2


def test_warnings_of_workers_are_issued_in_the_calling_process(capfd):
    with Workers(1) as workers, warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always")
        found = dict(run_tasks(square, {"two": 2, "three": 3}, workers))
    assert found == {"two": 4, "three": 9}
    texts = [str(warning.message) for warning in issued]
    assert texts.count("the same") >= 1 and {"of 2", "of 3"} < set(texts)
    assert "Warning" not in capfd.readouterr().err
