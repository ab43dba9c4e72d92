"""What could make a policy update faster, each beside the update as it is: `python -m experiments.benchmarks.variants`.

The policy updates of an iteration on target A, preset `fast`, sampling included, on one core: `apt_jax.learner.update` as it
is, changed in one place, or compiled with other flags of XLA.  Each side lives in a process of its own and they take turns, so
that what slows the machine for a while slows all of them.  What is changed learns the same (`tests/test_benchmarks.py`).
"""

from __future__ import annotations

import dataclasses
import os
import statistics
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Int, Key

from apt_jax import learner
from apt_jax.config import HParams
from apt_jax.descent import adam_step
from apt_jax.learner import LearnerState
from apt_jax.losses import td_errors, td_target
from apt_jax.networks import QNetwork
from apt_jax.networks.apply import apply
from apt_jax.networks.encoders import Encoder, Head, observation_features
from apt_jax.replay import Batch, Replay
from apt_jax.specs import Grid, Modality, Obs, Vector
from apt_jax.trainer import Clock, make_trainer
from experiments.benchmarks import _measure
from experiments.benchmarks._in_turns import Begun, Worker
from experiments.benchmarks._measure import Options, Problem, Timing
from experiments.benchmarks._parts import SOURCES, sample_batches
from experiments.errors import UsageError, exit_with

LANES = 16
"""32-bit numbers in a vector register of AVX-512."""


@dataclass(frozen=True)
class Args(Options):
    """Time variants of the policy updates of one iteration.

    Attributes:
      space: where to train.
      only: names of variants beside the first, by default all.
      iterations: of training, each with as many updates as the preset has, per measurement.
    """

    space: Literal["grid_world", "manipulation"] = "grid_world"
    only: tuple[str, ...] = ()
    iterations: int = 50


class Material(NamedTuple):
    """What the updates of an iteration work with.

    Attributes:
      network: the Q-network.
      bounds: low and high, of the next-Q clip.
      hparams: the preset's.
      sample: `sample(replay, key, batches)`: as many batches, leaves [batches, B, ...]; consumes `key`.
      updates: in an iteration.
    """

    network: QNetwork
    bounds: tuple[Array, Array]
    hparams: HParams
    sample: Callable[[Replay, Key[Array, ""], int], Batch]
    updates: int


Run = Callable[[LearnerState, Replay, Key[Array, ""]], LearnerState]
"""All policy updates of an iteration, sampling included; consumes the key."""


class Variant(NamedTuple):
    """How the updates are computed, for which network, and flags for the compiler."""

    make: Callable[[Material], Run]
    flags: str = ""
    widen: bool = False


def scan_updates(material: Material, update: Callable[[LearnerState, Batch], LearnerState]) -> Run:
    """All batches sampled at once, then one update after another."""

    def run(state: LearnerState, rings: Replay, key: Key[Array, ""]) -> LearnerState:
        batches = material.sample(rings, key, material.updates)
        return jax.lax.scan(lambda carry, batch: (update(carry, batch), None), state, batches)[0]

    return run


def as_it_is(material: Material) -> Run:
    """`learner.update`."""
    return scan_updates(material, partial(_update, material))


def _update(material: Material, state: LearnerState, batch: Batch) -> LearnerState:
    low, high = material.bounds
    return learner.update(material.network, state, batch, low=low, high=high, hparams=material.hparams)[0]


def sampled_one_by_one(material: Material) -> Run:
    """Each batch is drawn right before its update."""

    def run(state: LearnerState, rings: Replay, key: Key[Array, ""]) -> LearnerState:
        def step(carry: LearnerState, key: Key[Array, ""]) -> tuple[LearnerState, None]:
            batch = jax.tree.map(lambda x: x[0], material.sample(rings, key, 1))
            return _update(material, carry, batch), None

        return jax.lax.scan(step, state, jax.random.split(key, material.updates))[0]

    return run


Values = tuple[Array, Array, Array]
"""Of a batch: of the observation, and of the next one by the online and by the target network, each [B, A]."""


def _learn(material: Material, state: LearnerState, batch: Batch, values: Callable[[Any, Any], Values]) -> LearnerState:
    """`learner.update` with `values(params, target_params)` in place of its three forward passes."""
    low, high = material.bounds

    def loss(params: Any) -> Array:
        q, next_selector, next_value = values(params, state.target_params)
        target = td_target(
            reward=batch.reward,
            discount=batch.discount,
            next_q_selector=next_selector,
            next_q_value=next_value,
            low=low,
            high=high,
        )
        return jnp.mean(optax.losses.huber_loss(td_errors(q, batch.action, jax.lax.stop_gradient(target))))

    params, opt_state = adam_step(state.params, state.opt_state, jax.grad(loss)(state.params), material.hparams.learning_rate)
    target_params = optax.incremental_update(params, state.target_params, material.hparams.target_rate)
    return LearnerState(params, target_params, opt_state)


def networks_in_one_forward(material: Material) -> Run:
    """Online and target network as one batched forward pass over the next observation."""
    network = material.network

    def update(state: LearnerState, batch: Batch) -> LearnerState:
        def values(params: Any, target_params: Any) -> Values:
            both = jax.tree.map(lambda *leaves: jnp.stack(leaves), jax.lax.stop_gradient(params), target_params)
            next_selector, next_value = jax.vmap(lambda one: apply(network, one, batch.next_obs))(both)
            return apply(network, params, batch.obs), next_selector, next_value

        return _learn(material, state, batch, values)

    return scan_updates(material, update)


def observations_in_one_forward(material: Material) -> Run:
    """The online network sees both observations of a transition in one forward pass."""
    network = material.network

    def update(state: LearnerState, batch: Batch) -> LearnerState:
        def values(params: Any, target_params: Any) -> Values:
            both = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), batch.obs, batch.next_obs)
            q, next_selector = jnp.split(apply(network, params, both), 2)
            return q, next_selector, apply(network, target_params, batch.next_obs)

        return _learn(material, state, batch, values)

    return scan_updates(material, update)


def _q_of_features(material: Material) -> Callable[[Any, Any], Array]:
    """`q(params, features)`: the Q-network without what makes features of an observation."""
    spec = material.network.obs_spec

    def q(variables: Any, features: Any) -> Array:
        params = variables["params"]
        encoding = apply(Encoder(spec), {"params": params["encoder"]}, features)
        values: Array = apply(Head(material.network.num_actions), {"params": params["head"]}, encoding)
        return values

    return q


def features_at_once(material: Material) -> Run:
    """Casts, scaling and one-hot codes of all batches before the first update."""
    q, spec = _q_of_features(material), material.network.obs_spec

    def run(state: LearnerState, rings: Replay, key: Key[Array, ""]) -> LearnerState:
        batches = material.sample(rings, key, material.updates)
        features = jax.vmap(partial(observation_features, spec))

        def step(carry: LearnerState, inputs: tuple[Batch, Any, Any]) -> tuple[LearnerState, None]:
            batch, obs, next_obs = inputs

            def values(params: Any, target_params: Any) -> Values:
                return q(params, obs), q(params, next_obs), q(target_params, next_obs)

            return _learn(material, carry, batch, values), None

        return jax.lax.scan(step, state, (batches, features(batches.obs), features(batches.next_obs)))[0]

    return run


def _wide(modality: Modality) -> Modality:
    """A modality with as many inputs as fill whole vectors."""
    match modality:
        case Vector():
            return dataclasses.replace(modality, size=-(-modality.size // LANES) * LANES)
        case Grid():
            categories = -(-modality.categories // 4) * 4
            return dataclasses.replace(modality, width=-(-modality.width // 4) * 4, categories=categories)
    return modality


def padded_inputs(material: Material) -> Run:
    """Vectors and rows of grids with zeros up to multiples of a register's width, for a network that is larger by these."""
    spec = material.network.obs_spec

    def pad(name: str, x: Array) -> Array:
        modality = spec[name]
        size = modality.width if isinstance(modality, Grid) else modality.size if isinstance(modality, Vector) else x.shape[-1]
        return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, size - x.shape[-1])])

    def widened(obs: Obs) -> Obs:
        return {name: pad(name, x) for name, x in obs.items()}

    def run(state: LearnerState, rings: Replay, key: Key[Array, ""]) -> LearnerState:
        batches = material.sample(rings, key, material.updates)
        batches = batches._replace(obs=widened(batches.obs), next_obs=widened(batches.next_obs))
        return jax.lax.scan(lambda carry, batch: (_update(material, carry, batch), None), state, batches)[0]

    return run


FLAGS = (
    "xla_cpu_multi_thread_eigen=false",
    "xla_cpu_use_fusion_emitters=false",
    "xla_cpu_enable_fast_math=true",
    "xla_cpu_enable_fast_min_max=true",
    "xla_cpu_prefer_vector_width=512",
    "xla_cpu_enable_concurrency_optimized_scheduler=false",
)

FIRST = "as it is"

VARIANTS: Mapping[str, Variant] = {
    FIRST: Variant(as_it_is),
    "each batch sampled by itself": Variant(sampled_one_by_one),
    "features of all batches at once": Variant(features_at_once),
    "both networks in one forward pass": Variant(networks_in_one_forward),
    "both observations in one forward pass": Variant(observations_in_one_forward),
    "inputs padded to whole registers": Variant(padded_inputs, widen=True),
    **{flag: Variant(as_it_is, f"--{flag}") for flag in FLAGS},
}
"""What is compared, the update as it is first."""


def begin(name: str, rings: Replay, args: Args) -> Begun:
    """A variant on one core, with a replay from another process."""
    variant = VARIANTS[name]
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {variant.flags}".strip()
    _measure.pin(1)
    # No compilation cache: the seconds to compile are results too.
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", 1)
    problem = load_problem(args)

    # Nothing is a constant that training does not know either, or the compiler could compute with it.
    def loop(
        carry: tuple[LearnerState, Key[Array, ""]], fixed: tuple[Replay, HParams], length: Int[Array, ""]
    ) -> tuple[LearnerState, Key[Array, ""]]:
        rings, hparams = fixed
        run = variant.make(make_material(problem._replace(hparams=hparams), rings, widen=variant.widen))

        def iteration(_: Any, carry: tuple[LearnerState, Key[Array, ""]]) -> tuple[LearnerState, Key[Array, ""]]:
            state, key = carry
            key, key_run = jax.random.split(key)
            return run(state, rings, key_run), key

        return jax.lax.fori_loop(0, length, iteration, carry)

    network = make_material(problem, rings, widen=variant.widen).network
    carry = jax.jit(partial(learner.init, network))(jax.random.key(0)), jax.random.key(1)
    fixed = jax.device_put((rings, jax.tree.map(np.float32, problem.hparams)))
    compiled, compile_seconds = _measure.compile_ahead(jax.jit(loop, donate_argnums=0), carry, fixed, np.int32(1))

    def iterations() -> None:
        nonlocal carry
        carry = jax.block_until_ready(compiled(carry, fixed, np.int32(args.iterations)))

    iterations()  # nothing is warm for the first
    return iterations, compile_seconds


def load_problem(args: Args) -> Problem:
    """Preset `fast` without what a policy update does not need."""
    return _measure.load_problem("fast", space=args.space, method="random", **(_measure.QUICK if args.quick else {}))


def play(problem: Problem) -> Replay:
    """The replay after the warm-up, on the host."""
    trainer = make_trainer(problem.space, problem.config)
    state = jax.jit(trainer.init)(jax.random.key(0), problem.target, problem.hparams)
    state, _ = jax.jit(trainer.warmup, donate_argnums=0)(state, Clock.start(), problem.hparams)
    rings: Replay = jax.device_get(state.replay)
    return rings


def make_material(problem: Problem, rings: Replay, *, widen: bool = False) -> Material:
    """What the updates on a replay of `play` work with; `widen` makes the network that of padded inputs."""
    space, _, config, hparams = problem
    steps = SOURCES * config.envs_per_source
    latest = jnp.int32(config.warmup_steps // steps - 1)

    def sample(rings: Replay, key: Key[Array, ""], batches: int) -> Batch:
        return sample_batches(problem, rings, key, latest, batches)

    spec = {name: _wide(modality) for name, modality in space.obs_spec.items()} if widen else space.obs_spec
    network = QNetwork(spec, space.num_actions)
    return Material(network, rings.returns.bounds(), hparams, sample, config.updates_per_step * steps)


def table(timings: Mapping[str, Timing], updates: int) -> str:
    """What an update takes, and how much of that as it is."""
    first = timings[FIRST]
    rows = [
        [
            f"`{name}`" if name in FLAGS else name,
            timing.per(updates).cell(),
            ratio(timing, first),
            f"{timing.compile_seconds:.1f}",
        ]
        for name, timing in timings.items()
    ]
    return _measure.table(["policy update", "ms", "times the first", "compile, s"], rows)


def ratio(timing: Timing, first: Timing) -> str:
    """Median and range of how often another's time, turn by turn."""
    ratios = [own / other for own, other in zip(timing.seconds, first.seconds, strict=True)]
    return f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.variants")
    _measure.check(args)
    if unknown := [name for name in args.only if name not in VARIANTS]:
        raise UsageError(f"--only must be among {', '.join(VARIANTS)}; got {', '.join(unknown)}")
    if args.iterations < 1:
        raise UsageError(f"--iterations must be at least 1, got {args.iterations}")
    if args.quick:
        args = dataclasses.replace(args, repeats=2, iterations=1, only=args.only or tuple(VARIANTS)[1:2])
    names = [FIRST, *(name for name in args.only or VARIANTS if name != FIRST)]
    jax.config.update("jax_platforms", "cpu")
    problem = load_problem(args)
    rings = play(problem)
    with ExitStack() as stack:
        workers = {name: stack.enter_context(Worker(begin, name, rings, args)) for name in names}
        seconds: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(args.repeats):
            for name, worker in workers.items():
                seconds[name].append(worker.run() / args.iterations)
    timings = {name: Timing(tuple(seconds[name]), worker.compile_seconds) for name, worker in workers.items()}
    text = table(timings, problem.config.updates_per_step * SOURCES * problem.config.envs_per_source)
    name = "variants" if args.space == "grid_world" else f"variants_{args.space}"
    _measure.report(name, args, {"per_iteration": timings}, text)
    return 0


if __name__ == "__main__":
    exit_with(main)
