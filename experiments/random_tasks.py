"""A picture of uniformly random tasks: `python -m experiments.random_tasks --out FILE`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
import tyro

from experiments import plots, runtime
from experiments.errors import PICTURES, UsageError, check_output, exit_with
from experiments.problem import import_plugins
from experiments.settings import check_seed, make_space


@dataclass(frozen=True)
class Args:
    """Draw uniformly random tasks of a space.

    Attributes:
      out: the picture to write.
      space: the task space.
      plugins: Python modules to import first, which may add task spaces.
      rows: rows of tasks.
      columns: columns of tasks.
      seed: random seed of the tasks.
    """

    out: Path
    space: str = "grid_world"
    plugins: tuple[str, ...] = ()
    rows: int = 3
    columns: int = 8
    seed: int = 0


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.random_tasks")
    if min(args.rows, args.columns) < 1:
        raise UsageError(f"--rows and --columns must be at least 1, got {args.rows} and {args.columns}")
    check_output(args.out, PICTURES)
    check_seed(args.seed)
    runtime.setup()
    import_plugins(args.plugins)
    space = make_space(args.space)
    keys = jax.random.split(jax.random.key(args.seed), args.rows * args.columns)
    tasks = jax.device_get(jax.jit(jax.vmap(lambda key: space.instantiate(space.sample_uniform(key))))(keys))
    pictures = [space.render(jax.tree.map(lambda x: x[i], tasks)) for i in range(len(keys))]  # noqa: B023
    plots.gallery(args.out, pictures, columns=args.columns)
    return 0


if __name__ == "__main__":
    exit_with(main)
