"""Grid worlds with keys and doors, ours and those of others, each behind what a random walk needs of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

import envs
from apt_jax.specs import Obs
from envs.grid_world.board import BOARD, CATEGORIES, INTERIOR, LAVA, OBJECTS, START, WALL
from envs.grid_world.dynamics import HORIZON


class JaxWorld(NamedTuple):
    """An environment without resets; unbatched.

    Attributes:
      start: `start(key) -> state` of a task of its own drawing, observation included; consumes `key`.
      step: `step(state, action) -> state`.
      done: `done(state)`: whether the latest step ended an episode.
      num_actions: actions are [0, num_actions).
    """

    start: Callable[[Key[Array, ""]], Any]
    step: Callable[[Any, Int[Array, ""]], Any]
    done: Callable[[Any], Bool[Array, ""]]
    num_actions: int


class Walker(NamedTuple):
    """An environment of ours between two steps."""

    task: Any
    state: Any
    obs: Obs
    reward: Float[Array, ""]
    done: Bool[Array, ""]


def ours() -> JaxWorld:
    """Grid-World; a task is a parameter w, drawn uniformly and instantiated."""
    space = envs.make("grid_world")

    def start(key: Key[Array, ""]) -> Walker:
        key_w, key_reset = jax.random.split(key)
        task = space.instantiate(space.sample_uniform(key_w))
        return Walker(task, *space.reset(key_reset, task), jnp.float32(0.0), jnp.array(False))

    def step(walker: Walker, action: Int[Array, ""]) -> Walker:
        out = space.step(walker.state, action, walker.task)
        return Walker(walker.task, out.state, out.obs, out.reward, out.terminated | out.truncated)

    return JaxWorld(start, step, lambda walker: walker.done, space.num_actions)


def xminigrid() -> JaxWorld:
    """DoorKey of XLand-MiniGrid."""
    from xminigrid import make

    env, params = make("MiniGrid-DoorKey-8x8", height=BOARD, width=BOARD, max_steps=HORIZON)
    return JaxWorld(
        start=lambda key: env.reset(params, key),
        step=lambda state, action: env.step(params, state, action),
        done=lambda state: state.last(),
        num_actions=env.num_actions(params),
    )


def navix() -> JaxWorld:
    """DoorKey of NAVIX, agent and goal placed at random; its `step` without the reset that it begins with."""
    from navix import observations, rewards, terminations
    from navix.environments.door_key import DoorKey
    from navix.rendering.cache import RenderingCache

    env = DoorKey.create(
        height=BOARD,
        width=BOARD,
        max_steps=HORIZON,
        random_start=True,
        observation_fn=observations.symbolic_first_person,
        reward_fn=rewards.on_goal_reached,
        termination_fn=terminations.on_goal_reached,
    )
    # By default every state holds a picture of the board, 300 kB, which no symbol needs.
    no_picture = RenderingCache(patches=jnp.zeros((0,), jnp.uint8))
    return JaxWorld(
        start=lambda key: env.reset(key, no_picture),
        step=env._step,
        done=lambda state: state.is_done(),
        num_actions=len(env.action_set),
    )


def restart(world: JaxWorld, states: Any, key: Key[Array, ""], group: int) -> tuple[Any, Bool[Array, "n"]]:
    """Starts anew where an episode ended, `group` environments at a time; consumes `key`.

    Under `vmap` alone every environment would draw a task at every step, and nearly all would be thrown away.

    Returns:
      The states, leaves [n, ...], and where an episode ended.
    """
    done = jax.vmap(world.done)(states)
    rank = jnp.cumsum(done, dtype=jnp.int32) - 1

    def start_group(i: Int[Array, ""], carry: tuple[Any, Key[Array, ""]]) -> tuple[Any, Key[Array, ""]]:
        states, key = carry
        key, key_start = jax.random.split(key)
        fresh = jax.vmap(world.start)(jax.random.split(key_start, group))
        place = rank - i * group
        chosen = done & (place >= 0) & (place < group)

        def put(new: Array, old: Array) -> Array:
            return jnp.where(chosen.reshape(-1, *(1,) * (old.ndim - 1)), new[jnp.clip(place, 0, group - 1)], old)

        return jax.tree.map(put, fresh, states), key

    return jax.lax.fori_loop(0, (rank[-1] + group) // group, start_group, (states, key))[0], done


def minigrid_doorkey() -> Callable[[int], Any]:
    """DoorKey of MiniGrid."""
    from minigrid.envs import DoorKeyEnv

    return _vectorised(lambda: DoorKeyEnv(size=BOARD, max_steps=HORIZON, see_through_walls=True))


def minigrid_boards() -> Callable[[int], Any]:
    """MiniGrid on boards drawn as our task space draws them, by the rules of `envs.grid_world.placement`."""
    from minigrid.core.grid import Grid
    from minigrid.core.mission import MissionSpace
    from minigrid.core.world_object import Door, Goal, Key, Lava, Wall
    from minigrid.minigrid_env import MiniGridEnv

    class Board(MiniGridEnv):
        def _gen_grid(self, width: int, height: int) -> None:
            self.grid = Grid(width, height)
            self.grid.wall_rect(0, 0, width, height)
            tiles = self.np_random.integers(CATEGORIES, size=(INTERIOR, INTERIOR))
            for category, tile in ((WALL, Wall), (LAVA, Lava)):
                for x, y in np.argwhere(tiles == category).tolist():
                    self.grid.set(x + 1, y + 1, tile())
            self.grid.set(*START, None)
            objects = (Goal(), Door("yellow", is_locked=True), Door("blue", is_locked=True), Key("yellow"), Key("blue"))
            taken = set()
            for thing, (x, y) in zip(objects, self.np_random.integers(BOARD, size=(OBJECTS, 2)).tolist(), strict=True):
                on_border = min(x, y) == 0 or max(x, y) == BOARD - 1
                if not on_border and (x, y) not in taken and ((x, y) != START or isinstance(thing, Goal)):
                    self.grid.set(x, y, thing)
                    taken.add((x, y))
            self.agent_pos, self.agent_dir, self.mission = START, 0, ""

    mission = MissionSpace(mission_func=lambda: "")
    return _vectorised(lambda: Board(mission_space=mission, grid_size=BOARD, max_steps=HORIZON, see_through_walls=True))


def _vectorised(make: Callable[[], Any]) -> Callable[[int], Any]:
    """Environments one after another behind Gymnasium's vector API, without the checks of `gymnasium.make`, which cost time."""
    from gymnasium.vector import SyncVectorEnv
    from minigrid.wrappers import ImgObsWrapper

    return lambda n: SyncVectorEnv([lambda: ImgObsWrapper(make())] * n)


WORLDS: Mapping[str, Callable[[], JaxWorld | Callable[[int], Any]]] = {
    "Grid-World (ours)": ours,
    "xminigrid, DoorKey": xminigrid,
    "navix, DoorKey": navix,
    "MiniGrid, DoorKey": minigrid_doorkey,
    "MiniGrid, our boards": minigrid_boards,
}
"""By the name in the table what makes an environment in JAX, or a function from their number to MiniGrid's; ours first.  Raises
ImportError where the package is missing.
"""
