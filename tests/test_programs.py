"""A program that was compiled once is loaded by later starts, as long as it is made of the same."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import envs
from apt_jax.config import Config
from apt_jax.turns import Turns
from experiments import programs
from experiments.examples.corridor import Corridor
from experiments.programs import Programs
from experiments.settings import Experiment, Session
from experiments.train import kept_programs

ROOT = Path(__file__).parents[1]


class Doubling:
    """A jitted function that donates its argument and counts how often it is traced."""

    def __init__(self):
        self.traced = 0

        def double(state):
            self.traced += 1
            return {"x": 2 * state["x"], "key": jax.random.split(state["key"])[0]}

        self.jitted = jax.jit(double, donate_argnums=0)


def state(shape=(3,), dtype=np.float32, device=0):
    on = NamedSharding(Mesh(np.array(jax.devices()[device : device + 1]), ("lane",)), PartitionSpec())
    return jax.device_put({"x": jnp.ones(shape, dtype), "key": jax.random.key(0)}, on)


def data(tree):
    return np.asarray(tree["x"]), np.asarray(jax.random.key_data(tree["key"]))


def test_a_second_start_traces_nothing_and_computes_the_same(tmp_path):
    function = Doubling()
    results, given = [], []
    for loaded in (0, 1):
        own = Programs(tmp_path, "the same")
        given.append(state())
        results.append(data(own.compile("double", function.jitted, given[-1])(given[-1])))
        assert own.loaded == loaded
    assert function.traced == 1
    assert all(tree["x"].is_deleted() for tree in given)
    np.testing.assert_array_equal(results[0][0], [2, 2, 2])
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)


def test_several_are_compiled_and_found_together(tmp_path):
    Programs(tmp_path).compile("double", Doubling().jitted, state())
    functions = {"double": Doubling(), "half": Doubling()}
    for counts in ((1, 1), (2, 0)):
        own = Programs(tmp_path)
        programs = own.compile_all({name: function.jitted for name, function in functions.items()}, state())
        assert (own.loaded, own.compiled) == counts
        assert list(functions) == sorted(programs)
        np.testing.assert_array_equal([program(state())["x"] for program in programs.values()], [[2, 2, 2]] * 2)
    assert [function.traced for function in functions.values()] == [0, 1]


def test_one_that_cannot_be_compiled_says_why(tmp_path):
    def wrong(state):
        raise ValueError("no such state")

    with pytest.raises(ValueError, match="no such state"):
        Programs(tmp_path).compile_all({"double": Doubling().jitted, "wrong": jax.jit(wrong)}, state())
    assert jax.config.values["jax_enable_compilation_cache"]


def test_on_one_device_it_does_not_matter_how_an_array_is_said_to_be_split(tmp_path):
    Programs(tmp_path).compile("double", Doubling().jitted, state())
    again = state()
    mesh = Mesh(np.array(jax.devices()[:1]), ("lane",))
    again["x"] = jax.device_put(again["x"], NamedSharding(mesh, PartitionSpec("lane")))
    own = Programs(tmp_path)
    np.testing.assert_array_equal(own.compile("double", Doubling().jitted, again)(again)["x"], [2, 2, 2])
    assert own.loaded == 1


@pytest.mark.parametrize(
    ("name", "made_of", "argument"),
    [
        ("triple", "one", {}),
        ("double", "other", {}),
        ("double", "one", {"shape": (4,)}),
        ("double", "one", {"dtype": np.int32}),
        ("double", "one", {"device": 1}),
    ],
)
def test_what_differs_in_anything_is_another_program(tmp_path, name, made_of, argument):
    Programs(tmp_path, "one").compile("double", Doubling().jitted, state())
    own = Programs(tmp_path, made_of)
    expected = state(**argument)["x"]
    for loaded in (0, 1):
        result = own.compile(name, Doubling().jitted, state(**argument))(state(**argument))["x"]
        assert own.loaded == loaded
        assert (result.shape, result.dtype, result.sharding) == (expected.shape, expected.dtype, expected.sharding)


def test_lanes_that_take_turns_are_kept_too(tmp_path):
    mesh = Mesh(np.array(jax.devices()[:1]), ("lane",))
    lanes = np.arange(3, dtype=np.float32)
    traced = []

    def double(lanes):
        traced.append(lanes.shape)
        return 2 * lanes

    for loaded in (0, 1):
        own = Programs(tmp_path)
        compiled = own.compile("double", Turns(jax.jit(double), 3, 2, mesh), lanes)
        np.testing.assert_array_equal(compiled(lanes), [0, 2, 4])
        assert own.loaded == loaded
    assert traced == [(2,)]


def test_a_program_for_some_devices_is_not_found_by_a_start_that_has_more(monkeypatch):
    before = programs.machine()
    devices = jax.devices()
    monkeypatch.setattr(jax, "devices", lambda *_: devices[:1])
    assert programs.machine() != before


def test_a_damaged_file_is_made_anew(tmp_path):
    Programs(tmp_path).compile("double", Doubling().jitted, state())
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for damaged in (b"", whole[:-100], whole[:50] + b"x" + whole[51:]):
        file.write_bytes(damaged)
        with pytest.warns(UserWarning, match="cannot be loaded and is made anew"):
            compiled = Programs(tmp_path).compile("double", Doubling().jitted, state())
        np.testing.assert_array_equal(compiled(state())["x"], [2, 2, 2])
        assert found(Programs(tmp_path))


def test_where_nothing_can_be_written_a_run_goes_on(tmp_path):
    (tmp_path / "file").touch()
    with pytest.warns(UserWarning, match="could not be kept"):
        compiled = Programs(tmp_path / "file").compile("double", Doubling().jitted, state())
    np.testing.assert_array_equal(compiled(state())["x"], [2, 2, 2])


FACTORISE = """
import sys
from pathlib import Path
import jax
import jax.numpy as jnp
from experiments.programs import Programs

own = Programs(Path(sys.argv[1]))
square = 4.0 * jnp.eye(2)
factor = own.compile("factorise", jax.jit(jnp.linalg.cholesky), square)(square)
print(own.loaded, factor.tolist())
"""


def test_a_loaded_program_may_call_lapack(tmp_path):
    """In processes of their own: one that has lowered such a call before would hide what is missing."""
    for loaded in (0, 1):
        command = [sys.executable, "-c", FACTORISE, str(tmp_path)]
        process = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
        assert process.stdout == f"{loaded} [[2.0, 0.0], [0.0, 2.0]]\n"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """JAX's cache directory, and sources that a test may change."""
    (tmp_path / "sources").mkdir()
    monkeypatch.setattr(programs, "SOURCES", (tmp_path / "sources",))
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    reset_cache()


def found(own: Programs) -> bool:
    own.compile("double", Doubling().jitted, state())
    return own.loaded == 1


def kept(experiment: Experiment, session: Session, space: str = "grid_world") -> Programs:
    return kept_programs(experiment, session, envs.make(space))


def test_a_run_finds_what_another_of_its_kind_has_compiled(cache):
    experiment, session = Experiment(), Session(Path("run"))
    kinds = [
        (experiment, session),
        (dataclasses.replace(experiment, seeds=(0, 1)), session),
        (dataclasses.replace(experiment, config=Config(batch_size=64)), session),
        (dataclasses.replace(experiment, space="manipulation"), session),
        (experiment, dataclasses.replace(session, layout="vmap")),
    ]
    assert [found(kept(*kind)) for kind in kinds] == [False] * len(kinds)
    assert all(found(kept(*kind)) for kind in kinds)
    assert found(kept(dataclasses.replace(experiment, seeds=(5, 6, 7, 8, 9), env_steps=20_000), session))
    assert found(kept(experiment, Session(Path("another run"), resume=True)))
    assert found(kept(dataclasses.replace(experiment, target="B"), session))


def test_what_has_sources_of_others_several_processes_or_no_cache_is_not_kept(cache, monkeypatch):
    experiment, session = Experiment(), Session(Path("run"))
    monkeypatch.setitem(envs.SPACES, "corridor", Corridor)
    for kind in (
        (dataclasses.replace(experiment, plugins=("experiments.ladder_methods",)), session),
        (experiment, session, "corridor"),
        (experiment, dataclasses.replace(session, distributed=True)),
    ):
        assert not any(found(kept(*kind)) for _ in range(2))
    jax.config.update("jax_compilation_cache_dir", None)
    assert not any(found(kept(experiment, session)) for _ in range(2))


def test_other_sources_are_another_program(cache):
    file = cache / "sources" / "module.py"
    assert not found(Programs.of("run"))
    for text in ("x = 1", "x = 2"):
        file.write_text(text)
        assert not found(Programs.of("run"))
        assert found(Programs.of("run"))
    file.rename(file.with_name("other.py"))
    assert not found(Programs.of("run"))


def test_another_setting_of_jax_is_another_program(cache):
    assert not found(Programs.of("run"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        assert not found(Programs.of("run"))
    jax.config.update("jax_default_matmul_precision", "highest")
    try:
        assert not found(Programs.of("run"))
    finally:
        jax.config.update("jax_default_matmul_precision", None)
    assert found(Programs.of("run"))
