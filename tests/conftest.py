"""Shared set-up of the tests: the --slow switch, real data where present, Hypothesis profiles."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import jax
import pytest

ROOT = Path(__file__).resolve().parent.parent


def check_signatures() -> None:
    """Check the types and shapes that a signature states, at each call (jaxtyping, beartype).

    Where JAX takes arrays it takes NumPy's too, so both count as arrays. A test of what is raised
    for wrong arguments passes wrong arguments: inside ``pytest.raises`` nothing is checked.
    """
    import jaxtyping
    import numpy as np

    import jaxface._types
    import tests.signatures  # noqa: F401 the hook looks it up by name

    jaxface._types.Array = jax.Array | np.ndarray
    jaxtyping.install_import_hook("jaxface", "tests.signatures.checked")
    raises: Any = pytest.raises

    @contextlib.contextmanager
    def unchecked(*args: Any, **options: Any) -> Iterator[Any]:
        jaxtyping.config.update("jaxtyping_disable", True)
        try:
            with raises(*args, **options) as caught:
                yield caught
        finally:
            jaxtyping.config.update("jaxtyping_disable", False)

    pytest.raises = unchecked


if os.environ.get("JAXFACE_TYPECHECK"):  # before any module of the package is imported
    check_signatures()

hypothesis.settings.register_profile("local", deadline=None, max_examples=25)
hypothesis.settings.register_profile(
    "ci",
    deadline=None,
    max_examples=25,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run the tests marked slow as well")


def pytest_configure(config: pytest.Config) -> None:
    # Most of the time of a run is spent compiling; XLA's results are kept between runs.
    if hasattr(config, "cache"):  # absent under -p no:cacheprovider
        jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jaxface-xla")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--slow"):
        return
    skip = pytest.mark.skip(reason="slow: run with --slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real data ($JAXFACE_DATA, or shared/data next to the checkout)."""
    folder = Path(os.environ.get("JAXFACE_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set JAXFACE_DATA to the folder that has it)")
    return folder


@pytest.fixture
def x64():
    """Double precision inside one test."""
    with jax.enable_x64(True):
        yield
