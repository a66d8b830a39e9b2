"""After Ctrl-C, a process prints one line, leaves no unfinished file, and is killed by SIGINT."""

import os
import shlex
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from command_line import SMALL, write_pair
from sampled_cases import first_always
from synthetic import bumpy_mesh

from jaxsmw.io.meshes import write_mesh
from jaxsmw.runtime.files import atomic_write, remove_unfinished

LINE = "jaxsmw: interrupted; output files are complete or were not written.\n"
PROLOGUE = """
import os, signal, sys
def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
"""
RUN = "from jaxsmw.cli import main; main()"


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    return write_pair(tmp_path_factory.mktemp("pair"))


def started(program: str, *arguments: object, start_new_session: bool = False) -> subprocess.Popen[str]:
    """Start a process that runs `program` and then the command line."""
    return subprocess.Popen(
        [sys.executable, "-c", PROLOGUE + textwrap.dedent(program) + RUN, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=start_new_session,
    )


def assert_interrupted(
    process: subprocess.Popen[str],
    directory: Path | None,
    *,
    line: str = LINE,
    by: signal.Signals = signal.SIGINT,
) -> None:
    """Check that the process prints one line, leaves no file in the directory, and is killed by the signal."""
    try:
        output, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == -by, errors
    assert errors.endswith(line) and errors.count("jaxsmw: interrupted") == 1
    for complaint in ("Traceback", "Exception", "Error", "leaked"):
        assert complaint not in errors
    assert output == ""
    assert directory is None or list(directory.iterdir()) == []


@pytest.mark.parametrize(
    "module",
    first_always(
        ["argparse", "numpy", "jaxsmw.cli.match", "jaxlib._jax", "jax", "equinox", "scipy.sparse", "igl"],
        always=4,
    ),
)
def test_an_interrupted_import_ends_with_one_line(pair, tmp_path, module):
    program = f"""
    class Interrupting:
        def find_spec(name, *_):
            if name == {module!r}:
                interrupt()
    sys.meta_path.insert(0, Interrupting)
    """
    call = ("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--backend", "jax")
    assert_interrupted(started(program, *call), tmp_path)


# Python discards exceptions in callbacks of the garbage collector. JAX registers such a callback.
IN_GARBAGE_COLLECTION = """
    import gc
    import jaxsmw.matching.match
    usual = jaxsmw.matching.match.match
    def interrupt_late(phase, _):
        if phase == "start":
            gc.callbacks.clear()
            interrupt()
    def match_with_garbage(*arguments, **options):
        gc.callbacks.append(interrupt_late)
        gc.collect()
        return usual(*arguments, **options)
    jaxsmw.matching.match.match = match_with_garbage
    """
IN_A_WRITE = """
    import numpy as np
    def interrupt_and_write(file, *_):
        open(file, "w").write("half")
        interrupt()
        while True:
            pass
    np.savetxt = interrupt_and_write
    """
IN_COMPILED_CODE = """
    import threading
    import jaxsmw.matching.match
    from jaxsmw.runtime.files import atomic_write
    def match_forever(*_, **__):
        # This thread blocks the signal and deadlocks, like compiled code that never returns to Python.
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        with atomic_write(sys.argv[5]) as temporary:
            temporary.write_text("half")
            interrupt()
            lock = threading.Lock()
            lock.acquire()
            lock.acquire()
    jaxsmw.matching.match.match = match_forever
    """


@pytest.mark.slow
@pytest.mark.parametrize("program", [IN_GARBAGE_COLLECTION, IN_A_WRITE, IN_COMPILED_CODE])
def test_interrupted_work_leaves_no_files(pair, tmp_path, program):
    call = ("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--preset", "paper")
    call += ("--mirror", "no")  # otherwise the command prints which hand it matched
    call += ("--expected-error", tmp_path / "e") if program == IN_A_WRITE else ()
    process = started(program, *call)
    if program == IN_A_WRITE:  # this program is interrupted after it has written the map
        process.wait(timeout=60)
        (tmp_path / "m").unlink()
    assert_interrupted(process, tmp_path)


@pytest.mark.slow
def test_an_interrupted_refinement_ends_at_once(pair, tmp_path):
    """SIGINT ends compiled code that would run for hours."""
    call = (
        "match",
        pair / "x.off",
        pair / "y.ply",
        "--output",
        tmp_path / "m",
        *SMALL,
        "--iterations",
        10**7,
    )
    process = started("", *call)
    for line in process.stderr:
        if line.startswith("refinement"):
            break
    time.sleep(3)
    process.send_signal(signal.SIGINT)
    assert_interrupted(process, tmp_path)


@pytest.mark.slow
def test_an_interrupted_benchmark_prints_one_line(tmp_path):
    """A terminal also sends SIGINT to the worker processes, but only the main process prints a line."""
    data, output = tmp_path / "data", tmp_path / "output"
    data.mkdir()
    for number in range(3):
        write_mesh(data / f"mesh00{number}.off", bumpy_mesh(3))
    call = ("benchmark", data, "--methods", "initial", "--workers", "1", "--output", output)
    process = started("", *call, start_new_session=True)
    while not (output / "shapes.csv").exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    kept = f"finished pairs are kept in {output}, and the same command continues from there"
    assert_interrupted(process, None, line=f"\njaxsmw: interrupted; {kept}.\n")


def test_workers_do_not_receive_an_interruption_while_they_start():
    """The start of the first worker also starts Python's resource tracker, which unblocks SIGINT."""
    program = """
    import signal
    from jaxsmw.cli.interruption import quiet_children
    from jaxsmw.runtime.workers import Workers
    blocked = lambda: signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    if __name__ == "__main__":
        with quiet_children(), Workers(1) as executor:
            executor.submit(int).result()
            assert blocked()
        assert not blocked()
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_an_interruption_while_a_worker_starts_waits_until_the_worker_has_its_arguments():
    program = """
    import multiprocessing.util, time
    from jaxsmw.cli.interruption import end_when_interrupted, quiet_children
    from jaxsmw.runtime.workers import Workers
    spawn = multiprocessing.util.spawnv_passfds
    def interrupted(*arguments):
        process = spawn(*arguments)
        if b"spawn_main" in b"".join(map(os.fsencode, arguments[1])):
            interrupt()
            time.sleep(0.1)
        return process
    if __name__ == "__main__":
        end_when_interrupted()
        multiprocessing.util.spawnv_passfds = interrupted
        with quiet_children(), Workers(1) as executor:
            executor.submit(int).result()
    """
    ended = subprocess.run(
        [sys.executable, "-c", PROLOGUE + textwrap.dedent(program)], capture_output=True, text=True
    )
    assert (ended.returncode, ended.stderr) == (-signal.SIGINT, LINE)


def test_a_second_interruption_has_no_effect(pair, tmp_path):
    program = """
    import jaxsmw.matching.match
    def match_forever(*_, **__):
        interrupt(), interrupt(), interrupt()
    jaxsmw.matching.match.match = match_forever
    """
    call = ("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    assert_interrupted(started(program, *call), tmp_path)


@pytest.mark.parametrize("number", first_always([signal.SIGTERM, signal.SIGHUP]))
def test_other_signals_end_a_command_in_the_same_way(pair, tmp_path, number):
    program = f"""
    import jaxsmw.matching.match
    jaxsmw.matching.match.match = lambda *_, **__: os.kill(os.getpid(), {int(number)})
    """
    call = ("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    assert_interrupted(started(program, *call), tmp_path, by=number)


def test_an_ignored_signal_stays_ignored(pair):
    """Shell scripts start background jobs with SIGINT ignored."""
    program = "signal.signal(signal.SIGINT, signal.SIG_IGN); import atexit; atexit.register(interrupt)\n"
    process = started(program, "spectrum", pair / "x.off", "--eigenvectors", "5")
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0 and not errors and "area" in output


def test_a_shell_ends_its_loop_at_an_interruption(pair, tmp_path):
    """A shell ends its loop only if SIGINT kills the command, and not if the command exits by itself."""
    call = (
        sys.executable,
        "-m",
        "jaxsmw",
        "match",
        pair / "x.off",
        pair / "y.ply",
        "--output",
        tmp_path / "m",
    )
    command = shlex.join(map(str, (*call, *SMALL, "--iterations", 10**7)))
    loop = f"for i in 1 2; do {command}; echo next; done"
    shell = f"os.execvp('bash', ['bash', '-c', {loop!r}])"
    program = PROLOGUE + "signal.signal(signal.SIGINT, signal.SIG_DFL)\n" + shell
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    for line in process.stderr:
        if line.startswith("refinement"):
            break
    os.killpg(process.pid, signal.SIGINT)
    assert_interrupted(process, tmp_path)


def test_unfinished_files_are_removed(tmp_path):
    block = atomic_write(tmp_path / "file")
    block.__enter__().write_text("half")
    assert len(list(tmp_path.iterdir())) == 1
    remove_unfinished()
    assert list(tmp_path.iterdir()) == []
    with atomic_write(tmp_path / "file") as temporary:
        temporary.write_text("whole")
    remove_unfinished()
    assert (tmp_path / "file").read_text() == "whole"
