"""A film of a target's solution, played by the Sawyer arm: `python -m experiments.film --out FILE --target B`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import envs
import envs.rendering
from envs.manipulation import Space
from envs.manipulation.solver import solve
from envs.manipulation.targets import DEMONSTRATIONS
from experiments import episodes, runtime
from experiments.episodes import Episode
from experiments.errors import UsageError, check_output, exit_with
from experiments.problem import load_target
from experiments.settings import check_seed, make_space, target_path


@dataclass(frozen=True)
class Args:
    """Film the Sawyer arm solving a target of Manipulation; from above where this machine cannot draw the arm.

    Attributes:
      out: the GIF to write.
      target: a target's name, or a file that describes it.
      seed: random seed of the goal's place.
      robot: show the arm; without it, the table from above, one picture per push.
    """

    out: Path
    target: str = "A"
    seed: int = 0
    robot: bool = True


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.film")
    runtime.setup()
    film(args)
    return 0


def film(args: Args) -> None:
    """Writes a film of a shortest solution: the known one of a named target, else one that is searched for."""
    check_output(args.out, (".gif",))
    check_seed(args.seed)
    try:
        space = Space()
    except ValueError as error:
        raise UsageError(str(error)) from error
    file = target_path(space.name, args.target)
    task = load_target(space.name, args.target, file)
    actions = solve(task, space.goal_jitter) if file else DEMONSTRATIONS[args.target]
    if actions is None:
        raise UsageError(f"{file}: found no solution to film")
    sequence = jnp.asarray(actions)
    episode = episodes.play(space, task, lambda _, step: sequence[step], jax.random.key(args.seed))
    save(args.out, space, task, episode, robot=args.robot)


def check_robot(space: str) -> None:
    """Raises a `UsageError` unless the arm plays a space."""
    if not isinstance(make_space(space), Space):
        raise UsageError(f"the robot plays {Space.name}, not {space}")


def save(out: Path, space: envs.BenchmarkSpace, task: Any, episode: Episode, *, robot: bool) -> None:
    """Writes a film of an episode, played by the robot if asked for and this machine can draw it, else from above."""
    if robot and _save_robot(out, task, episode):
        return
    envs.rendering.save_gif(out, [space.render(task, state) for state in episode.states], space.fps)


def _save_robot(out: Path, task: Any, episode: Episode) -> bool:
    """Whether it could be drawn; tells how the arm fared, whose cans go their own way."""
    from envs.manipulation.sawyer import film as sawyer  # slow to import
    from envs.manipulation.sawyer.camera import NoGraphics

    try:
        frames, pushes = sawyer.film(task, np.asarray(episode.states[0].goal, float), episode.actions)
    except NoGraphics as error:
        print(f"{error}; the film shows the table from above", file=sys.stderr)
        return False
    outcome = "success" if pushes[-1].success else pushes[-1].event or "no success"
    print(f"the arm: {outcome} after {len(pushes)} pushes")
    envs.rendering.save_gif(out, frames, sawyer.FPS)
    return True


if __name__ == "__main__":
    exit_with(main)
