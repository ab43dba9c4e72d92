"""One seed of training as pure functions: `chunk` is a scan of iterations followed by an evaluation.

    act -> step -> write -> learn -> adapt        every iteration
    refresh the curriculum (beta, mixtures)       every `Config.refresh_every` environment steps
    evaluate, keep or restore the policy          every `Config.eval_every` environment steps: the end of a chunk

The caller batches over seeds and hyper-parameters and jits (`apt_jax.lanes`).  The clock is never batched.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Key

from apt_jax import evaluation, learner, replay, workers
from apt_jax.bonuses.base import Step
from apt_jax.checks import check_sizes, check_space, check_target
from apt_jax.config import Config, HParams, check_ranges
from apt_jax.curricula.base import GENERATED, TARGET
from apt_jax.methods import make_method
from apt_jax.networks import QNetwork
from apt_jax.plugin import Metrics, no_update
from apt_jax.specs import Obs, Params
from apt_jax.task_space import TaskSpace

Carry = TypeVar("Carry")
F = TypeVar("F", bound=Callable[..., Any])

_REFRESH_STREAM = 1_000_033
"""Refreshing draws from a stream of its own, so that curricula which draw nothing there change nothing elsewhere."""


class Clock(NamedTuple):
    """How far training has come, the same for all seeds: iterations and environment steps of all sources, below 2^31."""

    iteration: Int[Array, ""]
    env_steps: Int[Array, ""]

    @classmethod
    def start(cls) -> Clock:
        """The clock before the first iteration."""
        return cls(jnp.int32(0), jnp.int32(0))


class TrainState(NamedTuple):
    """Everything of one seed.  The target is data, so that one compiled program serves every target of a space."""

    target: Any
    key: Key[Array, ""]
    key_eval: Key[Array, ""]
    learner: learner.LearnerState
    kept: learner.Kept
    curriculum: Any
    bonus: Any
    replay: replay.Replay
    workers: workers.Workers

    @property
    def policy(self) -> Any:
        """Parameters for `Trainer.act`: the averaged Q-network that the restore rule keeps, whose score is `target_return`."""
        return self.kept.learner.target_params


class Trainer(NamedTuple):
    """Pure, unbatched functions of one seed.

    Attributes:
      space: the task space.
      config: the static configuration.
      generates: whether there is a generated source.
      init: `init(key, target, hparams) -> TrainState` for a target task of the space; consumes `key`.  Raises a `ValueError`
        while it is traced for a target that is not like the space's tasks.
      warmup: `warmup(state, clock, hparams) -> (state, clock)`: `Config.warmup_steps` of random actions, no updates.
      chunk: `chunk(state, clock, hparams) -> (state, clock, metrics)`: `Config.eval_every` steps, then an evaluation.
      propose: `propose(state, key, n, hparams) -> w`: tasks the curriculum would generate now, leaves [n, ...], for a Python
        int n; consumes `key`.
      act: `act(params, obs) -> action`: greedy, for `TrainState.policy` and observations with any leading axes.
    """

    space: TaskSpace
    config: Config
    generates: bool
    init: Callable[[Key[Array, ""], Any, HParams], TrainState]
    warmup: Callable[[TrainState, Clock, HParams], tuple[TrainState, Clock]]
    chunk: Callable[[TrainState, Clock, HParams], tuple[TrainState, Clock, Metrics]]
    propose: Callable[[TrainState, Key[Array, ""], int, HParams], Params]
    act: Callable[[Any, Obs], Int[Array, "..."]]


def make_trainer(space: TaskSpace, config: Config) -> Trainer:
    """The trainer of a configuration for the targets of `space`.

    Raises:
      ValueError: an unknown method, sizes that do not fit together (what, and what is allowed), a space that is not what its
        specs say, or JAX set to 64 bits.
    """
    if jax.dtypes.canonicalize_dtype(float) != jnp.float32:
        raise ValueError("apt_jax computes with 32 bits: unset jax_enable_x64 (JAX_ENABLE_X64)")
    check_ranges(config)
    check_space(space)
    curriculum, bonus = make_method(space, config)
    sources = 2 if curriculum.generates else 1
    learns = any(plugin.update is not no_update for plugin in (curriculum, bonus))
    check_sizes(config, sources, space.horizon, learns)
    network = QNetwork(space.obs_spec, space.num_actions)
    envs = config.envs_per_source
    steps = sources * envs

    def assign(target: Any, state: Any, key: Key[Array, ""], hparams: HParams) -> workers.Assignment:
        w = curriculum.propose(state, key, envs, hparams) if curriculum.generates else None
        return workers.assign(space, target, w, envs)

    def init(key: Key[Array, ""], target: Any, hparams: HParams) -> TrainState:
        check_target(space, target)
        key, key_eval, key_learner, key_curriculum, key_assign, key_start, key_bonus = jax.random.split(key, 7)
        learner_state = learner.init(network, key_learner)
        curriculum_state = curriculum.init(key_curriculum, hparams)
        environments = workers.start(space, assign(target, curriculum_state, key_assign, hparams), key_start)
        return TrainState(
            target=jax.tree.map(jnp.array, target),  # a copy: states are donated
            key=key,
            key_eval=key_eval,
            learner=learner_state,
            kept=learner.Kept(jax.tree.map(jnp.copy, learner_state), jnp.float32(jnp.nan)),
            curriculum=curriculum_state,
            bonus=bonus.init(key_bonus, environments.state, hparams),
            replay=replay.init(
                space.obs_spec,
                space.param_spec if curriculum.generates else {},
                sources=sources,
                envs=envs,
                columns=config.replay_steps // envs,
                episodes=config.replay_episodes,
                note=bonus.note,
            ),
            workers=environments,
        )

    def collect(
        state: TrainState, clock: Clock, key: Key[Array, ""], epsilon: Float[Array, ""] | float, hparams: HParams
    ) -> TrainState:
        """Act, step and write: one step of every environment.  All writes come before any read of the rings."""
        key_act, key_assign, key_step = jax.random.split(key, 3)
        action = learner.epsilon_greedy(network, state.learner.params, state.workers.obs, key_act, epsilon)
        assignment = assign(state.target, state.curriculum, key_assign, hparams)
        after, transition, true_state, episode, done = workers.step(
            space, state.workers, action, assignment, clock.iteration, key_step, rollouts=curriculum.rollouts
        )
        bonus_state, note = bonus.annotate(state.bonus, Step(transition, true_state, after.state), hparams)
        rings = replay.write(state.replay, clock.iteration, transition._replace(note=note), episode, done)
        return state._replace(workers=after, bonus=bonus_state, replay=rings)

    def tick(clock: Clock) -> Clock:
        return Clock(clock.iteration + 1, clock.env_steps + steps)

    def learn(state: TrainState, clock: Clock, key: Key[Array, ""], hparams: HParams) -> tuple[TrainState, Metrics]:
        batches = replay.sample_transitions(
            state.replay,
            key,
            clock.iteration,
            batches=config.updates_per_step * steps,
            batch_size=config.batch_size,
            n_step=config.n_step,
            success_share=config.success_share,
            horizon=space.horizon,
            gamma=hparams.gamma,
        )
        low, high = bonus.return_range(state.bonus, state.replay)

        def update(carry: learner.LearnerState, batch: replay.Batch) -> tuple[learner.LearnerState, Metrics]:
            reward, bonus_metrics = bonus.reward(state.bonus, batch, hparams)
            batch = batch._replace(reward=reward)
            carry, metrics = learner.update(network, carry, batch, low=low, high=high, hparams=hparams)
            return carry, {**metrics, **bonus_metrics}

        learner_state, metrics = _scan(update, state.learner, batches)
        return state._replace(learner=learner_state), metrics

    def adapt(state: TrainState, clock: Clock, key: Key[Array, ""], hparams: HParams) -> tuple[TrainState, Metrics]:
        def update(carry: tuple[Any, Any, Key[Array, ""]], _: None) -> tuple[tuple[Any, Any, Key[Array, ""]], Metrics]:
            curriculum_state, bonus_state, key = carry
            key, key_curriculum, key_bonus = jax.random.split(key, 3)
            curriculum_state, metrics = curriculum.update(
                curriculum_state, key_curriculum, state.replay, clock.iteration, hparams
            )
            bonus_state, bonus_metrics = bonus.update(bonus_state, key_bonus, state.replay, clock.iteration, hparams)
            return (curriculum_state, bonus_state, key), {**metrics, **bonus_metrics}

        rounds = round(config.model_updates_per_step * steps) if learns else 0
        (curriculum_state, bonus_state, _), metrics = _scan(update, (state.curriculum, state.bonus, key), length=rounds)
        return state._replace(curriculum=curriculum_state, bonus=bonus_state), metrics

    def iteration(carry: tuple[TrainState, Clock], hparams: HParams) -> tuple[tuple[TrainState, Clock], Metrics]:
        state, clock = carry
        key, key_collect, key_learn, key_adapt = jax.random.split(state.key, 4)
        epsilon = learner.epsilon_schedule(clock.env_steps - config.warmup_steps, hparams)
        state = collect(state._replace(key=key), clock, key_collect, epsilon, hparams)
        state, learner_metrics = learn(state, clock, key_learn, hparams)
        state, curriculum_metrics = adapt(state, clock, key_adapt, hparams)
        return (state, tick(clock)), {"epsilon": epsilon, **learner_metrics, **curriculum_metrics}

    def warmup(state: TrainState, clock: Clock, hparams: HParams) -> tuple[TrainState, Clock]:
        def step(carry: tuple[TrainState, Clock], _: None) -> tuple[tuple[TrainState, Clock], None]:
            state, clock = carry
            key, key_collect = jax.random.split(state.key)
            return (collect(state._replace(key=key), clock, key_collect, 1.0, hparams), tick(clock)), None

        return jax.lax.scan(step, (state, clock), length=config.warmup_steps // steps)[0]

    def evaluate(state: TrainState, clock: Clock, hparams: HParams) -> tuple[TrainState, Metrics]:
        """Greedy return on the target, the restore rule, and the curriculum judged on fresh tasks, by the averaged policy.

        Draws from `key_eval` alone: how often it is done changes no draw of training, but how often the restore rule is asked,
        and the resets.
        """
        key_propose, key_play, key_steps, key_reset = jax.random.split(jax.random.fold_in(state.key_eval, clock.env_steps), 4)
        trained = clock.env_steps - config.warmup_steps
        episodes = config.eval_episodes
        tasks = jax.tree.map(lambda x: jnp.broadcast_to(x, (episodes, *jnp.shape(x))), state.target)
        epsilon = jnp.zeros(episodes)
        w = curriculum.propose(state.curriculum, key_propose, config.probe_tasks, hparams) if curriculum.generates else None
        if w is not None:
            tasks = jax.tree.map(lambda *sources: jnp.concatenate(sources), tasks, jax.vmap(space.instantiate)(w))
            explores = learner.epsilon_schedule(trained, hparams)
            epsilon = jnp.concatenate([epsilon, jnp.full(config.probe_tasks, explores)])

        def act(obs: Obs, key: Key[Array, ""]) -> Int[Array, "n"]:
            return learner.epsilon_greedy(network, state.learner.target_params, obs, key, epsilon)

        # All side by side: the environments' step is compiled and looped over once.
        played = evaluation.play(space, tasks, act, key_play)
        outcome, _ = jax.tree.map(lambda x: x[:episodes], played)
        score = jnp.mean(outcome.episode_return)
        learner_state, kept, restored = learner.keep_or_restore(state.learner, state.kept, score)
        learner_state, reset = learner.reset(
            network, learner_state, kept, key_reset, steps=trained, every=config.eval_every, hparams=hparams
        )
        metrics = {
            "target_return": kept.score,
            "target_return_raw": score,
            "target_success_raw": jnp.mean(outcome.success.astype(jnp.float32)),
            "restored": restored.astype(jnp.float32),
            "reset": reset.astype(jnp.float32),
            **_sources(state.replay, config.return_window, since=config.warmup_steps // steps),
        }
        if w is not None:
            probe, transitions, probe_tasks = jax.tree.map(lambda x: x[episodes:], (*played, tasks))
            rollouts = evaluation.sample_rollouts(w, probe, transitions, key_steps, steps=space.horizon)
            descriptions = jax.vmap(lambda task: space.describe(task, state.target))(probe_tasks)
            metrics |= {
                "probe_return": jnp.mean(probe.episode_return),
                "probe_success": jnp.mean(probe.success.astype(jnp.float32)),
                **evaluation.diversity(space.param_spec, w),
                **{f"probe_{name}": jnp.nanmean(values) for name, values in descriptions.items()},
                **curriculum.report(state.curriculum, rollouts, hparams),
            }
        return state._replace(learner=learner_state, kept=kept), metrics

    def chunk(state: TrainState, clock: Clock, hparams: HParams) -> tuple[TrainState, Clock, Metrics]:
        def refresh_period(carry: tuple[TrainState, Clock], _: None) -> tuple[tuple[TrainState, Clock], Metrics]:
            (state, clock), metrics = _scan(lambda c, _: iteration(c, hparams), carry, length=config.refresh_every // steps)
            key_refresh = jax.random.fold_in(state.key, _REFRESH_STREAM)
            refreshed = curriculum.refresh(state.curriculum, key_refresh, state.replay, clock.iteration, hparams)
            return (state._replace(curriculum=refreshed), clock), metrics

        (state, clock), metrics = _scan(refresh_period, (state, clock), length=config.eval_every // config.refresh_every)
        state, eval_metrics = evaluate(state, clock, hparams)
        return state, clock, {**metrics, **eval_metrics}

    def propose(state: TrainState, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        return curriculum.propose(state.curriculum, key, n, hparams)

    def act(params: Any, obs: Obs) -> Int[Array, "..."]:
        return learner.greedy(network, params, obs)

    return Trainer(
        space=space,
        config=config,
        generates=curriculum.generates,
        init=_in_float32(init),
        warmup=_in_float32(warmup),
        chunk=_in_float32(chunk),
        propose=_in_float32(propose),
        act=_in_float32(act),
    )


def _in_float32(function: F) -> F:
    """Whole float32 products also where accelerators would round a matmul's inputs: values of actions differ by less."""

    @wraps(function)
    def precise(*args: Any, **options: Any) -> Any:
        with jax.default_matmul_precision("highest"):
            return function(*args, **options)

    return cast(F, precise)


def _sources(rings: replay.Replay, window: int, since: int) -> Metrics:
    """Recent outcome of each source as the behaviour policy had it after the warm-up."""
    names = {TARGET: "behaviour", GENERATED: "generated"}
    return {
        f"{names[source]}_{name}": value
        for source in range(rings.finished.shape[0])
        for name, value in replay.recent_outcome(rings, source=source, window=window, since=since).items()
    }


def _scan(
    step: Callable[[Carry, Any], tuple[Carry, Metrics]], carry: Carry, xs: Any = None, *, length: int | None = None
) -> tuple[Carry, Metrics]:
    """`jax.lax.scan` of a step that yields scalar metrics, with their means; kept as one array, they compile sooner."""
    as_metrics = None

    def packed(carry: Carry, x: Any) -> tuple[Carry, Float[Array, "metrics"]]:
        nonlocal as_metrics
        carry, metrics = step(carry, x)
        flat, as_metrics = ravel_pytree(metrics)
        return carry, flat

    carry, values = jax.lax.scan(packed, carry, xs, length=length)
    assert as_metrics is not None, "a scan traces its step, also if it makes none"
    return carry, as_metrics(jnp.mean(values, axis=0))
