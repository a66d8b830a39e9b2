"""Settings and fixtures for all tests."""

import functools
import gc
import os
import pickle
import shutil
import signal
import sys
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import jax
import jaxtyping
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

# Each worker, and each command that the tests start, loads the bytecode that the first of them writes. Without
# bytecode, each process would compile the package and all tests anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A shell script starts background commands with an ignored SIGINT, and `nohup` ignores SIGHUP. The commands that the
# tests start and interrupt would inherit these settings.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
# Imports create many objects and no garbage. `pytest_collection_finish` enables garbage collection again.
gc.disable()

# The tests spend most of their time compiling small programs that run once. XLA's older loop emitters reduce
# the compilation time to a third. The flags are set only for versions of JAX that have them, because XLA ends the
# process at an unknown flag.
if jax.__version_info__[:2] == (0, 10):
    # By default, XLA splits each program into up to 32 parts and compiles the parts in several threads. One part
    # takes a quarter less CPU time, and the parallel workers of the tests occupy all cores anyway.
    flags = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}"
jax.config.update("jax_disable_most_optimizations", True)
# Without this setting, JAX records the call stack of every operation, which takes 10 % of the test time.
jax.config.update("jax_include_full_tracebacks_in_locations", False)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# `beartype` suppresses warnings while it decorates a function. If two threads do so at once, the one that ends last can
# leave all warnings suppressed (before Python 3.14), and `pytest.warns` then sees none. So they take turns.
_turns = threading.RLock()
_enter, _exit = warnings.catch_warnings.__enter__, warnings.catch_warnings.__exit__


def _in_turn(context: warnings.catch_warnings) -> Any:
    if threading.current_thread() is not threading.main_thread():
        _turns.acquire()
    return _enter(context)


def _end_turn(context: warnings.catch_warnings, *error: Any) -> None:
    _exit(context, *error)
    if threading.current_thread() is not threading.main_thread():
        _turns.release()


warnings.catch_warnings.__enter__, warnings.catch_warnings.__exit__ = _in_turn, _end_turn

# A Hypothesis example may compile a program, which can take longer than Hypothesis's default deadline.
hypothesis.settings.register_profile("default", deadline=None, derandomize=True)
hypothesis.settings.load_profile("default")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that chooses a twentieth of the tests with the marker `sampled`."""
    parser.addoption(
        "--sample",
        metavar="COMMIT",
        help="run only a twentieth of the tests marked `sampled`, which a hash chooses",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep every twentieth test with the marker `sampled`, from a start that the option `--sample` chooses."""
    commit = config.getoption("sample")
    if commit is None:
        return
    sampled = [item for item in items if item.get_closest_marker("sampled")]
    left_out = [item for i, item in enumerate(sampled) if (i + zlib.crc32(commit.encode())) % 20]
    remaining = set(map(id, items)) - set(map(id, left_out))
    items[:] = [item for item in items if id(item) in remaining]
    config.hook.pytest_deselected(items=left_out)


def pytest_collection_finish() -> None:
    """Make garbage collection rare, and exempt all objects that exist before the first test.

    Otherwise, garbage collection takes 9 % of the test time, because tracing creates many objects.
    """
    gc.enable()
    gc.set_threshold(200_000, 20, 20)
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The directory with real shapes (`data/`) and reference results (`oracle/`).

    `JAXSMW_SHARED` names the directory. The default is `shared/` next to the checkout. If the directory is
    missing, the tests on real shapes are skipped. If the environment variable `CI` is also set, these
    tests fail instead, because a skip would hide that nothing was tested.
    """
    default = Path(__file__).resolve().parents[2] / "shared"
    directory = Path(os.environ.get("JAXSMW_SHARED", default))
    if not (directory / "data").is_dir() or not (directory / "oracle").is_dir():
        message = f"no real shapes at {directory}: set JAXSMW_SHARED to the directory with data/ and oracle/"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return directory


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A headless Chromium with software rendering."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if not chromium or not driver:
        message = "the page is tested in Chromium: install chromium and chromedriver"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-gpu-rasterization",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-dev-shm-usage",
        "--disable-sync",
        "--no-first-run",
        f"--user-data-dir={tmp_path_factory.mktemp('chromium')}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=Service(driver))
    yield chrome
    chrome.quit()


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """The names of all programs that any thread compiles during a test."""
    names: list[str] = []

    def listen(event: str, duration: float, **details: str) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(details["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(autouse=True, scope="session")
def one_thread_each() -> Iterator[None]:
    """Limit each pytest-xdist worker, and the commands that it starts, to one thread.

    Otherwise the threads of parallel workers would wait for each other.
    """
    alone = "PYTEST_XDIST_WORKER" not in os.environ
    with pytest.MonkeyPatch.context() as patch, threadpool_limits(None if alone else 1):
        if not alone:
            patch.setenv("OPENBLAS_NUM_THREADS", "1")
        yield


@pytest.fixture(scope="session")
def common_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A temporary directory that all parallel processes of one run of the tests share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(autouse=True, scope="session")
def compile_once(common_directory: Path) -> Iterator[None]:
    """Share one cache of compiled programs among all commands that the tests start.

    The commands compile as fast as the tests do.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(common_directory / "programs"))
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")
        patch.setenv("JAX_INCLUDE_FULL_TRACEBACKS_IN_LOCATIONS", "false")
        yield


@pytest.fixture(autouse=True, scope="session")
def triangulate_creatures_once(common_directory: Path) -> Iterator[None]:
    """Share the triangulations of creatures among all test processes, because each takes a second or more."""
    # The type checks apply only to modules that are imported after this file.
    from jaxsmw import creature
    from jaxsmw.runtime.cache import Store

    directory = common_directory / "creatures"
    directory.mkdir(exist_ok=True)
    store, triangulated = Store(directory), creature._triangulated

    def stored(
        body: creature._Body, count: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        inputs = pickle.dumps(body).hex(), count, str(random.bit_generator.state)
        arrays = store.load("creature", inputs)
        if arrays is None:
            arrays = dict(zip(("vertices", "faces"), triangulated(body, count, random), strict=True))
            store.save("creature", inputs, arrays)
        return arrays["vertices"], arrays["faces"]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(creature, "_triangulated", stored)
        yield


@pytest.fixture(autouse=True, scope="session")
def private_cache(common_directory: Path) -> Iterator[None]:
    """Keep tests from reading or filling the user's cache, and share one cache among all test processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXSMW_CACHE", str(common_directory / "cache"))
        yield


@pytest.fixture(autouse=True, scope="session")
def make_one_parser() -> Iterator[None]:
    """Give all commands of one process the same parser.

    The parser contains many small functions, and the type checks take about a millisecond for each.
    """
    from jaxsmw.cli import run

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "make_parser", functools.cache(run.make_parser))
        yield


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Release compiled programs after each test module, because the programs of all tests take gigabytes."""
    yield
    _release_programs()


@pytest.fixture
def no_programs() -> None:
    """Release all programs before a test that counts compilations."""
    _release_programs()


def _release_programs() -> None:
    from jaxsmw.runtime import compilation

    compilation._compiled.cache_clear()
    jax.clear_caches()


@pytest.fixture(params=["jax", "numpy"])
def namespace(request: pytest.FixtureRequest) -> str:
    """The namespace of the arrays: tests with this fixture run with JAX and with NumPy."""
    return request.param


@pytest.fixture
def refine(namespace: str) -> Callable[..., Any]:
    """The function `refine` for arrays of each namespace."""
    # The type checks apply only to modules that are imported after this file.
    from synthetic import refine_in

    return functools.partial(refine_in, namespace)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """A function that runs the command line in this process."""
    # The type checks apply only to modules that are imported after this file.
    from command_line import runner

    return runner(capsys)


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw pictures with a ninth of the usual pixels, to save time."""
    monkeypatch.setattr("jaxsmw.report.figures._DPI", 67)
    monkeypatch.setattr("jaxsmw.report.figures._BODY_SIZE", (267, 267))


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the run-time type checks, which only the tests use.

    The type checks would raise errors before the library raises its own errors.
    """
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
