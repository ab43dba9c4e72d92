"""What was experienced: a ring of transitions per environment and a ring of finished episodes per source.

All sources write one column of the transition ring per iteration, at the same unbatched position, so that a write is one
in-place `dynamic_update_slice` (under `vmap` a scatter, in place too) and an episode lies contiguously (modulo the capacity) in
its environment's row.

Axes: S sources, E environments per source, T columns, N episode slots.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer, Key

from apt_jax import draws
from apt_jax.specs import Obs, Params, Spec, obs_struct, param_struct, zeros_like


class Transition(NamedTuple):
    """One environment step.  `next_obs` is the true observation after it, also where an episode ended.

    `done` is terminated or truncated: the next column belongs to another episode.  `note` is what the intrinsic reward keeps of
    the step (`apt_jax.bonuses`), by default nothing.
    """

    obs: Obs
    action: Integer[Array, "..."]
    reward: Float[Array, "..."]
    next_obs: Obs
    terminated: Bool[Array, "..."]
    done: Bool[Array, "..."]
    note: Any = ()


class Batch(NamedTuple):
    """Transitions over n steps to learn from, leaves [..., B, ...].

    `reward` is the discounted sum of the rewards on the way; `discount` multiplies the value of `next_obs`: gamma to the number
    of steps made, 0 after a termination.  `note` is that of the first step.
    """

    obs: Obs
    action: Integer[Array, "..."]
    reward: Float[Array, "..."]
    next_obs: Obs
    discount: Float[Array, "..."]
    note: Any = ()


class Episode(NamedTuple):
    """A finished episode: its task parameter, where its steps lie in the transition ring, and its outcome.

    Attributes:
      w: without leaves where nothing is generated.
      env: index of its environment, in [0, E).
      end: iteration of its last step; those of the others lie before it, one each.
      length: steps.
      episode_return: undiscounted.
      success: at any of its steps.
    """

    w: Params
    env: Int[Array, "..."]
    end: Int[Array, "..."]
    length: Int[Array, "..."]
    episode_return: Float[Array, "..."]
    success: Bool[Array, "..."]


class ReturnRange(NamedTuple):
    """Smallest and largest undiscounted return of the episodes finished so far, +inf and -inf before the first."""

    low: Float[Array, ""]
    high: Float[Array, ""]

    @classmethod
    def empty(cls) -> ReturnRange:
        """The range of no episode."""
        return cls(jnp.float32(jnp.inf), jnp.float32(-jnp.inf))

    def extend(self, episode_return: Float[Array, "S E"], done: Bool[Array, "S E"]) -> ReturnRange:
        """With the returns that `done` marks."""
        return ReturnRange(
            jnp.minimum(self.low, jnp.min(episode_return, initial=jnp.inf, where=done)),
            jnp.maximum(self.high, jnp.max(episode_return, initial=-jnp.inf, where=done)),
        )

    def bounds(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Both ends; unbounded before the first finished episode."""
        none = self.low > self.high
        return jnp.where(none, -jnp.inf, self.low), jnp.where(none, jnp.inf, self.high)


class Replay(NamedTuple):
    """Both rings of every source and the range of episodic returns seen so far.

    Attributes:
      transitions: leaves [S, E, T, ...]; column `i % T` holds iteration i.
      episodes: leaves [S, N, ...]; slot `i % N` holds the i-th finished episode of the source.
      finished: episodes finished so far, [S].
      returns: range of the returns of all sources.
    """

    transitions: Transition
    episodes: Episode
    finished: Int[Array, "S"]
    returns: ReturnRange


class Rollouts(NamedTuple):
    """Sampled episodes of one source, each with its first observation and K of its steps; leaves [B, ...], [B, K, ...]."""

    w: Params
    initial_obs: Obs
    steps: Transition
    length: Int[Array, "B"]
    episode_return: Float[Array, "B"]


def init(obs_spec: Spec, param_spec: Spec, *, sources: int, envs: int, columns: int, episodes: int, note: Any = ()) -> Replay:
    """An empty replay; `note` is the structure (`ShapeDtypeStruct`s) of one step's note.

    `param_spec` is to be empty where nothing is generated.
    """
    obs = zeros_like(obs_struct(obs_spec), (sources, envs, columns))
    step = (sources, envs, columns)
    slot = (sources, episodes)
    return Replay(
        transitions=Transition(
            obs=obs,
            action=jnp.zeros(step, jnp.uint8),
            reward=jnp.zeros(step, jnp.float32),
            next_obs=jax.tree.map(jnp.copy, obs),
            terminated=jnp.zeros(step, bool),
            done=jnp.zeros(step, bool),
            note=zeros_like(note, step),
        ),
        episodes=Episode(
            w=zeros_like(param_struct(param_spec), slot),
            env=jnp.zeros(slot, jnp.int32),
            end=jnp.full(slot, jnp.iinfo(jnp.int32).min, jnp.int32),
            length=jnp.ones(slot, jnp.int32),
            episode_return=jnp.zeros(slot, jnp.float32),
            success=jnp.zeros(slot, bool),
        ),
        finished=jnp.zeros(sources, jnp.int32),
        returns=ReturnRange.empty(),
    )


def write(
    replay: Replay, iteration: Int[Array, ""], transition: Transition, episode: Episode, done: Bool[Array, "S E"]
) -> Replay:
    """Write one transition of every environment and the episodes that `done` marks; leaves [S, E, ...].

    Iterations count up from 0 without a gap: an episode's steps are found by that.
    """
    columns = replay.transitions.action.shape[2]
    slots = replay.episodes.env.shape[1]
    position = iteration % columns

    def put_column(ring: Array, value: Array) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, value[:, :, None].astype(ring.dtype), position, axis=2)

    # An unfinished episode is scattered out of bounds, where "drop" discards it: a branch or a mask would copy the ring.
    order = jnp.cumsum(done, axis=1, dtype=jnp.int32) - 1
    slot = jnp.where(done, (replay.finished[:, None] + order) % slots, slots)
    source = jnp.arange(done.shape[0], dtype=jnp.int32)[:, None]
    return Replay(
        transitions=jax.tree.map(put_column, replay.transitions, transition),
        episodes=jax.tree.map(lambda ring, value: ring.at[source, slot].set(value, mode="drop"), replay.episodes, episode),
        finished=replay.finished + jnp.sum(done, axis=1, dtype=jnp.int32),
        returns=replay.returns.extend(episode.episode_return, done),
    )


def sample_transitions(
    replay: Replay,
    key: Key[Array, ""],
    iteration: Int[Array, ""],
    *,
    batches: int,
    batch_size: int,
    n_step: int,
    gamma: Float[Array, ""] | float,
    success_share: float,
    horizon: int,
) -> Batch:
    """`batches` of `batch_size` n-step transitions in equal shares from the sources; consumes `key`.

    A transition stops early where its episode ends and at the latest step written: it then spans fewer than `n_step` steps.

    Args:
      iteration: the latest iteration written.
      success_share: share drawn as a step of a successful episode, in [0, 1], as far as a source has any; the others are drawn
        uniformly from all steps.
      horizon: steps of the longest possible episode; an episode that ended too long ago to be whole is not drawn.

    Returns:
      Leaves [batches, batch_size, ...].
    """
    sources, envs, columns = replay.transitions.action.shape
    share = batch_size // sources
    key_step, *keys_success = jax.random.split(key, 3)
    env, first = _draw_steps(replay, key_step, iteration, (sources, batches, share))
    from_successes = round(success_share * share)
    if from_successes:
        kept, replaced = ((env[..., part], first[..., part]) for part in (slice(from_successes, None), slice(from_successes)))
        drawn = _draw_successes(replay, keys_success, iteration, horizon, otherwise=replaced)
        env, first = (jnp.concatenate(parts, axis=-1) for parts in zip(drawn, kept, strict=True))
    row = (jnp.arange(sources, dtype=jnp.int32)[:, None, None] * envs + env) * columns

    # One flat index over sources, environments and columns: a single leading index is the cheapest gather on every backend.
    def gather(ring: Array, at: Int[Array, "S batches share"]) -> Array:
        return ring.reshape(sources * envs * columns, *ring.shape[3:])[row + at % columns]

    rings = replay.transitions
    reward = gather(rings.reward, first)
    discount = jnp.full(first.shape, gamma, jnp.float32)
    last = first
    for _ in range(n_step - 1):
        goes_on = ~gather(rings.done, last) & (last < iteration)
        last = jnp.where(goes_on, last + 1, last)
        reward = reward + jnp.where(goes_on, discount * gather(rings.reward, last), 0.0)
        discount = jnp.where(goes_on, discount * gamma, discount)
    batch = Batch(
        obs=jax.tree.map(lambda ring: gather(ring, first), rings.obs),
        action=gather(rings.action, first),
        reward=reward,
        next_obs=jax.tree.map(lambda ring: gather(ring, last), rings.next_obs),
        discount=jnp.where(gather(rings.terminated, last), 0.0, discount),
        note=jax.tree.map(lambda ring: gather(ring, first), rings.note),
    )
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(batches, sources * share, *x.shape[3:]), batch)


Positions = tuple[Int[Array, "S batches n"], Int[Array, "S batches n"]]
"""Environment and iteration of steps of every source."""


def _draw_steps(replay: Replay, key: Key[Array, ""], iteration: Int[Array, ""], shape: tuple[int, int, int]) -> Positions:
    """Steps drawn uniformly from the ring; consumes `key`."""
    _, envs, columns = replay.transitions.action.shape
    age, env = jnp.divmod(draws.integers(key, shape, envs * jnp.minimum(iteration + 1, columns)), envs)
    return env, iteration - age


def _draw_successes(
    replay: Replay, keys: Sequence[Key[Array, ""]], iteration: Int[Array, ""], horizon: int, *, otherwise: Positions
) -> Positions:
    """Successful episodes drawn uniformly, and of each a step drawn uniformly, where a source has any; consumes both `keys`."""
    columns = replay.transitions.action.shape[2]
    key_episode, key_step = keys
    shape = otherwise[0].shape
    # The first steps of an episode that ended longer ago may be overwritten.
    whole = replay.episodes.end > iteration - columns + horizon
    counted = jnp.cumsum(whole & replay.episodes.success, axis=1, dtype=jnp.int32)
    count = counted[:, -1][:, None, None]
    rank = 1 + draws.integers(key_episode, shape, jnp.maximum(count, 1))
    slot = jax.vmap(jnp.searchsorted)(counted, rank)
    source = jnp.arange(shape[0], dtype=jnp.int32)[:, None, None]
    age = draws.integers(key_step, shape, replay.episodes.length[source, slot])
    drawn = replay.episodes.env[source, slot], replay.episodes.end[source, slot] - age
    env, first = (jnp.where(count > 0, new, old) for new, old in zip(drawn, otherwise, strict=True))
    return env, first


def sample_rollouts(
    replay: Replay,
    key: Key[Array, ""],
    iteration: Int[Array, ""],
    *,
    source: Int[Array, ""] | int,
    batch_size: int,
    steps: int,
    recent: int,
    recency: Float[Array, ""] | float,
) -> Rollouts:
    """Episodes of a source that ended within the last `recent` iterations, with replacement; consumes `key`.

    Args:
      iteration: the latest iteration written.
      steps: transitions drawn (with replacement) from each episode.
      recency: of n such episodes, ordered from the latest, number floor(n u^recency) is drawn, with u uniform in [0, 1): 1
        draws uniformly, 3 draws half from the latest eighth; at least 1.
    """
    slots = replay.episodes.end.shape[1]
    columns = replay.transitions.action.shape[2]
    key_episode, key_step = jax.random.split(key)
    count = jnp.sum(replay.episodes.end[source] > iteration - recent, dtype=jnp.int32)
    share = jax.random.uniform(key_episode, (batch_size,)) ** recency
    back = jnp.minimum((share * count.astype(jnp.float32)).astype(jnp.int32), jnp.maximum(count - 1, 0))
    slot = (replay.finished[source] - 1 - back) % slots
    picked = jax.tree.map(lambda ring: ring[source, slot], replay.episodes)
    start = picked.end - picked.length + 1
    offset = draws.integers(key_step, (batch_size, steps), picked.length[:, None])

    def gather(ring: Array, at: Int[Array, "..."]) -> Array:
        env = picked.env.reshape(batch_size, *(1,) * (at.ndim - 1))
        return ring[source, env, at % columns]

    transitions = replay.transitions
    return Rollouts(
        w=picked.w,
        initial_obs=jax.tree.map(lambda ring: gather(ring, start), transitions.obs),
        steps=jax.tree.map(lambda ring: gather(ring, start[:, None] + offset), transitions),
        length=picked.length,
        episode_return=picked.episode_return,
    )


def latest_episodes(replay: Replay, *, source: int, count: int) -> tuple[Episode, Int[Array, "n"]]:
    """A source's latest episodes, newest first, and how many were finished before each: negative where there is none.

    At most `count`, and no more than the replay holds.
    """
    slots = replay.episodes.env.shape[1]
    back = jnp.arange(min(count, slots), dtype=jnp.int32)
    earlier = replay.finished[source] - 1 - back
    return jax.tree.map(lambda ring: ring[source, earlier % slots], replay.episodes), earlier


def recent_outcome(replay: Replay, *, source: int, window: int, since: int = 0) -> dict[str, Any]:
    """Mean return, success rate and length of those of a source's last `window` episodes that began at `since` or later.

    NaN before the first.
    """
    episodes, earlier = latest_episodes(replay, source=source, count=window)
    valid = (earlier >= 0) & (episodes.end - episodes.length + 1 >= since)

    names = ("episode_return", "success", "length")
    outcomes = jnp.stack([getattr(episodes, name).astype(jnp.float32) for name in names])
    return dict(zip(names, jnp.mean(outcomes, axis=1, where=valid), strict=True))
