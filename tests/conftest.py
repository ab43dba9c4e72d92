"""Strict JAX for every test, on two host devices.

* two CPU devices in each process, so that sharding is exercised for real;
* a key used twice is an error (`jax_debug_key_reuse`);
* mixing dtypes or ranks implicitly is an error (strict promotion);
* an argument or result that is not what its annotation says, shapes included, is an error (jaxtyping);
* programs are compiled without LLVM's optimisations and by XLA's simpler emitters, which takes half the time: each runs a few
  times on small arrays, so compiling is what costs;
* compiled programs are dropped now and then: every one holds memory maps, and a process that has too many dies.

The settings are global rather than per test, so that module-scoped fixtures compile under them too.  A test that has to
break one says so with `@pytest.mark.relaxed("dtype")` (any of "dtype", "rank", "keys", "types"), and why.
"""

from __future__ import annotations

import functools
import os
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
FAST_COMPILE = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FAST_COMPILE}"

import hypothesis
import jax
import jaxtyping
import optax
import pytest

# Shapes and types of annotations hold.  Not those of `HParams`, whose numbers may be traced, or stacked for lanes.
PACKAGE = Path(__file__).parents[1] / "apt_jax"
CHECKED = [f"apt_jax.{module.name}" for module in pkgutil.iter_modules([str(PACKAGE)]) if module.name != "config"]
jaxtyping.install_import_hook([*CHECKED, "envs"], "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

import envs
import experiments.examples.corridor

# It makes itself known, as a plug-in does; tests begin with what a user finds, whichever of them are run together.
del envs.SPACES[experiments.examples.corridor.Corridor.name]

jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_debug_key_reuse", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Compilation makes the first example slow, and a run must not depend on what an earlier one stored.
hypothesis.settings.register_profile("strict", deadline=None, derandomize=True, database=None, max_examples=30)
hypothesis.settings.load_profile("strict")


@contextmanager
def _unchecked() -> Iterator[None]:
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


RELAXATIONS: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "dtype": lambda: jax.numpy_dtype_promotion("standard"),
    "rank": lambda: jax.numpy_rank_promotion("allow"),
    "keys": lambda: jax.debug_key_reuse(False),
    "types": _unchecked,
}


def _standard_promotion(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def relaxed(*args: Any, **kwargs: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"):
            return function(*args, **kwargs)

    return relaxed


# Adam's bias correction raises a float to an int32 power, the one place in optax that strict promotion stops.
optax.tree.bias_correction = _standard_promotion(optax.tree.bias_correction)


LONGEST = (
    "torch_fixture",
    "trainer",
    "resuming",
    "sawyer",
    "bonuses",
    "manipulation_training",
    "sawyer_mjx",
    "apt_gen",
    "benchmarks",
    "manipulation_tasks",
    "manipulation_physics",
    "train_cli",
    "runner",
    "examples",
    "networks",
    "curricula",
    "compiled_program",
)
"""Files that take half a minute or more.

Before them the one that imports PyTorch: where OpenGL has drawn first, Mesa's LLVM and PyTorch's compiler end the process.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, so that processes side by side end together."""
    places = {f"test_{name}": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


MAPS, MANY, TOO_MANY = Path("/proc/self/maps"), 20_000, 45_000
"""Where Linux lists a process's memory maps; it allows 65,530 (`vm.max_map_count`)."""


def _drop_programs(limit: int) -> None:
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > limit:
        jax.clear_caches()


@pytest.fixture(autouse=True, scope="module")
def _few_programs_at_the_end_of_a_file() -> Iterator[None]:
    """Within a file, tests share programs."""
    yield
    _drop_programs(MANY)


@pytest.fixture(autouse=True)
def _never_too_many_programs() -> Iterator[None]:
    yield
    _drop_programs(TOO_MANY)


@pytest.fixture(autouse=True)
def _relaxed(request: pytest.FixtureRequest) -> Iterator[None]:
    """Loosens what the test's `relaxed` markers name."""
    with ExitStack() as stack:
        for marker in request.node.iter_markers("relaxed"):
            for name in marker.args:
                stack.enter_context(RELAXATIONS[name]())
        yield
