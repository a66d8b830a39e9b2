"""What every test shares: double precision and strict promotion on, and where the real shapes lie."""

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import jaxtyping
import pytest
from threadpoolctl import threadpool_limits

# Most of the time goes into compiling small programs that run once. XLA's older way to emit loops compiles them
# three times as fast. Asked for only where it is known: a flag that XLA does not know ends the process.
if jax.__version_info__[:2] == (0, 10):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false"
jax.config.update("jax_disable_most_optimizations", True)
# Nor is it worth a tenth of the time to note for every operation in which line of which function it was called.
jax.config.update("jax_include_full_tracebacks_in_locations", False)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Compiling is slow the first time, which is no failure.
hypothesis.settings.register_profile("default", deadline=None, derandomize=True)
hypothesis.settings.load_profile("default")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The directory with real shapes (`data/`) and reference results (`oracle/`).

    `JAXSMW_SHARED` names it; by default it is `shared/` beside the checkout. Without it the tests on real
    shapes skip, except where `CI` is set: there a silent skip would hide that nothing was tested.
    """
    default = Path(__file__).resolve().parents[2] / "shared"
    directory = Path(os.environ.get("JAXSMW_SHARED", default))
    if not (directory / "data").is_dir() or not (directory / "oracle").is_dir():
        message = f"no real shapes at {directory}: set JAXSMW_SHARED to the directory with data/ and oracle/"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return directory


@pytest.fixture(autouse=True, scope="session")
def one_thread_each() -> Iterator[None]:
    """Test processes side by side do not wait for each other's threads; nor do the commands they start."""
    alone = "PYTEST_XDIST_WORKER" not in os.environ
    with pytest.MonkeyPatch.context() as patch, threadpool_limits(None if alone else 1):
        if not alone:
            patch.setenv("OPENBLAS_NUM_THREADS", "1")
        yield


@pytest.fixture(autouse=True, scope="session")
def compile_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Commands that tests start, again and again, share their compiled programs, also between workers."""
    base = tmp_path_factory.getbasetemp()
    programs = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "programs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(programs))
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        yield


@pytest.fixture(autouse=True, scope="session")
def private_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests neither read nor fill the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXSMW_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Compiled programs go when their tests are done: those of the whole suite would take gigabytes."""
    yield
    jax.clear_caches()


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs the library as users do: without run-time checks of types, which would pre-empt its own messages."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
