"""Shared fixtures and settings of all tests. jaxtyping's shapes are enforced on every call."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
import jax
import jaxlib
import jaxtyping
import pytest
from jax.experimental.compilation_cache import compilation_cache

TWO_DEVICES = "--xla_force_host_platform_device_count=2"
"""Flag of XLA that makes tests run on two devices, so that sharding is tested."""
# Most of the time of a test goes into compiling a program that runs for milliseconds. Without optimization,
# and with the older loop emitters, this takes a quarter of the time. With --all, programs are optimized.
QUICK = (
    f"{TWO_DEVICES} --xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    + " --xla_cpu_use_fusion_emitters=false" * jaxlib.__version__.startswith("0.10.")
)
"""Flags of XLA for fast compilation. Versions from 0.11 on have no older emitters, and abort at an unknown
flag."""
MIN_COMPILE_SECONDS = 0.05
"""Programs that compile faster are not cached, since writing and reading them takes time, too."""

jaxtyping.install_import_hook(["mgpo_jax", "envs"], "beartype.beartype")
jax.config.update("jax_numpy_rank_promotion", "allow")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the slow tests too")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: runs only with --all")
    config.addinivalue_line("markers", "optimized: runs with programs that compile as for users")
    # By default xdist begins with the files of many tests, so that a long file of few tests comes last,
    # while the other process has nothing left to do.
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    # XLA reads its flags when jax first needs a device, which happens later.
    os.environ.setdefault("XLA_FLAGS", TWO_DEVICES if config.getoption("--all") else QUICK)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--all"):
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="slow: pass --all"))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test marked ``optimized`` in its own process, if this process compiles without optimization.

    XLA reads its flags once per process. These tests compare different programs bit for bit, or are
    sensitive to small differences that grow over many steps.
    """
    quick = os.environ["XLA_FLAGS"].startswith(QUICK)  # envs.compiler may have added to it
    if "optimized" not in pyfuncitem.keywords or not quick:
        return None
    words = [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", "no:cacheprovider"]
    variables = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    done = subprocess.run(
        [*words, str(pyfuncitem.path) + pyfuncitem.nodeid[pyfuncitem.nodeid.index("::") :]],
        cwd=pyfuncitem.config.rootpath,
        env={**variables, "XLA_FLAGS": TWO_DEVICES},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout, done.stdout
    return True


def require_kitchen() -> None:
    """Skip the calling test module if the kitchen's dependencies are missing."""
    from envs.kitchen import import_mujoco

    try:
        import_mujoco()
    except ImportError as error:
        pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(autouse=True, scope="session")
def _compiled_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Share compiled programs between all tests and workers of a run, with jax's persistent cache."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "compiled"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    compilation_cache.reset_cache()  # some modules compile on import


MOST_MAPPINGS = 15_000  # memory mappings of this process; Linux allows 65,530


@pytest.fixture(autouse=True, scope="module")
def _few_programs() -> Iterator[None]:
    """Drop compiled programs between modules when there are many, since each has memory mappings."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > MOST_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)
