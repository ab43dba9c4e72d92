"""Checkpoints come back bit for bit, or fail with a message that says why."""

from __future__ import annotations

import gc
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax import checkpoint


def make_tree() -> dict[str, Any]:
    keys = jax.random.split(jax.random.key(7), 3)
    return {
        "key": keys,
        "weights": jax.vmap(lambda key: jax.random.normal(key, (4, 2)))(keys),
        "board": jnp.arange(6, dtype=jnp.uint8),
        "clock": (jnp.int32(5), None),
    }


def raw(leaf: jax.Array) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def test_round_trip_is_bit_for_bit(tmp_path: Path) -> None:
    tree = make_tree()
    checkpoint.save(tmp_path, 10, tree)
    restored = checkpoint.restore(tmp_path, tree)
    assert str(jax.tree.structure(restored)) == str(jax.tree.structure(tree))
    for old, new in zip(jax.tree.leaves(tree), jax.tree.leaves(restored), strict=True):
        assert old.dtype == new.dtype
        np.testing.assert_array_equal(raw(old), raw(new))


def test_only_the_latest_step_is_kept(tmp_path: Path) -> None:
    assert checkpoint.latest_step(tmp_path / "absent") is None
    checkpoint.save(tmp_path, 10, make_tree())
    checkpoint.save(tmp_path, 20, make_tree())
    assert checkpoint.latest_step(tmp_path) == 20
    assert not (tmp_path / "10").exists()


def test_a_step_that_is_not_new_is_refused(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 20, make_tree())
    for step in (10, 20):
        with pytest.raises(checkpoint.CheckpointError, match=f"has a checkpoint of step 20, got step {step} to save"):
            checkpoint.save(tmp_path, step, make_tree())


def test_an_unfinished_save_leaves_the_previous_one(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 10, make_tree())
    shutil.copytree(tmp_path / "10", tmp_path / "20.orbax-checkpoint-tmp")
    assert checkpoint.latest_step(tmp_path) == 10
    checkpoint.restore(tmp_path, make_tree())


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(checkpoint.CheckpointError, match="no checkpoint"):
        checkpoint.restore(tmp_path, make_tree())


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("fault", ["foreign", "damaged"])
def test_a_checkpoint_that_cannot_be_read_is_named(tmp_path: Path, fault: str) -> None:
    checkpoint.save(tmp_path, 10, make_tree())
    template = make_tree()
    if fault == "foreign":
        template["weights"] = jnp.zeros((3, 4, 5))
    else:
        shutil.rmtree(tmp_path / "10" / "default" / "d")
    with pytest.raises(checkpoint.CheckpointError, match=r"checkpoint 10 .* cannot be restored"):
        checkpoint.restore(tmp_path, template)
    gc.collect()  # coroutines that orbax leaves behind complain here, not in another test


def test_rows_are_the_leading_axis_that_all_arrays_share(tmp_path: Path) -> None:
    tree = make_tree()
    del tree["board"]
    checkpoint.save(tmp_path, 1, tree)
    assert checkpoint.rows(tmp_path) == 3
    checkpoint.save(tmp_path, 2, make_tree())
    with pytest.raises(checkpoint.CheckpointError, match=r"checkpoint 2 .* cannot be restored"):
        checkpoint.rows(tmp_path)


def test_arrays_are_placed_as_the_template_says(tmp_path: Path) -> None:
    mesh = jax.make_mesh((1,), ("lanes",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("lanes"))
    checkpoint.save(tmp_path, 1, {"x": jnp.arange(4)})
    restored = checkpoint.restore(tmp_path, {"x": jax.ShapeDtypeStruct((4,), jnp.int32, sharding=sharding)})
    assert restored["x"].sharding == sharding
