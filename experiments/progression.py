"""Tasks that a run generated, over time, beside the target: `python -m experiments.progression --run-dir DIR --out FILE`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments import film, pictures, plots, run_dir, runtime, settings
from experiments.errors import PICTURES, UsageError, check_output, exit_with
from experiments.problem import import_plugins, load_target


@dataclass(frozen=True)
class Args:
    """Draw the tasks that a run generated, over time, beside the target.

    Attributes:
      run_dir: a directory that experiments.train wrote.
      out: the picture to write.
      robot: draw them in three dimensions in front of the Sawyer arm, in Manipulation; needs OpenGL.
    """

    run_dir: Path
    out: Path
    robot: bool = False


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.progression")
    runtime.setup()
    draw(args)
    return 0


def draw(args: Args) -> None:
    """Writes the picture.

    Raises:
      UsageError: no run, no tasks in it, no folder to write to, no robot in its space, or no OpenGL to draw it with.
    """
    check_output(args.out, PICTURES)
    experiment = settings.load(args.run_dir)
    if not run_dir.task_files(args.run_dir):
        raise UsageError(
            f"{args.run_dir} holds no generated tasks (tasks/*.npz): its method generates none, it has not begun to, or they "
            "were left out"
        )
    import_plugins(experiment.plugins)
    target = load_target(experiment.space, experiment.target, experiment.target_file)
    space = settings.make_space(experiment.space)
    picture: Callable[[Any], plots.Image] = space.render
    if args.robot:
        film.check_robot(experiment.space)
        from envs.manipulation.sawyer import film as sawyer  # slow to import
        from envs.manipulation.sawyer.camera import NoGraphics

        picture = sawyer.picture
        try:
            picture(target)
        except NoGraphics as error:
            raise UsageError(f"--robot: {error}") from error
    pictures.draw_progression(args.out, args.run_dir, experiment, space, target, picture)


if __name__ == "__main__":
    exit_with(main)
