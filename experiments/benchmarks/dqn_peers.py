"""Q-learning alone, beside the DQN of two libraries: `python -m experiments.benchmarks.dqn_peers`.

CartPole, one environment, one core.  Common to ours (method `dqn`), rejax's and Stable-Baselines3's: hidden layers of 64 and
128 units with ReLU, batches of 128, the replay's capacity, the updates after every step, Adam, and epsilon 0.1 all the time.
The libraries are the extra `peers`; without it there is nothing to compare.  What differs:

* The environment: ours and rejax's program contain that of gymnax, Stable-Baselines3 steps that of Gymnasium in Python.
* Ours is Double DQN with a Huber loss and clipped next values.  The average network moves after every update, with the others
  after every step.  Each measurement ends with an episode of evaluation, 500 forward passes of one observation.
* rejax's is Double DQN with squared errors.  It draws batches without replacement, at a cost that grows with the capacity.
* Stable-Baselines3's is DQN with a Huber loss and one forward pass less; the norm of its gradients is bounded.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import tyro

from apt_jax.config import Config, HParams
from apt_jax.networks.encoders import ENCODING_SIZE, MERGE_SIZE
from apt_jax.trainer import Clock, make_trainer
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import UsageError, exit_with

PEERS = ("rejax", "gymnax", "stable-baselines3", "torch", "gymnasium")
HIDDEN = (ENCODING_SIZE, MERGE_SIZE)
BATCH = 128
WARMUP = 1_000
"""Steps before the first update."""
HPARAMS = HParams(epsilon_start=0.1, epsilon_end=0.1)


@dataclass(frozen=True)
class Args(Options):
    """Time Q-learning, ours and that of libraries.

    Attributes:
      updates: policy updates per environment step.
      capacity: steps that the replay holds.
      steps: environment steps per measurement.
    """

    updates: int = 2
    capacity: int = 10_000
    steps: int = 1_000


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.dqn_peers")
    _measure.check(args)
    if min(args.updates, args.steps) < 1 or args.capacity < 2 * WARMUP:
        raise UsageError(
            f"--updates and --steps must be at least 1, got {args.updates} and {args.steps}, and --capacity at least "
            f"{2 * WARMUP}, got {args.capacity}"
        )
    missing = [name for name in ("gymnax", "rejax", "stable_baselines3") if importlib.util.find_spec(name) is None]
    if missing:
        print(f"left out: everything ({', '.join(missing)} not installed; `make peers` installs the extra)")
        return 0
    _measure.pin(1)
    # No compilation cache: the seconds to compile are results too.
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", 1)
    if args.quick:
        args = dataclasses.replace(args, repeats=2, steps=20)
    results = {name: measure(args) for name, measure in SIDES.items()}
    _measure.report("dqn_peers", args, {"per_step": results}, table(results, args.updates), peers=PEERS)
    return 0


def time_ours(args: Args) -> Timing:
    """An environment step of ours with its updates."""
    from experiments.benchmarks._cart_pole import TASK, CartPole

    config = Config(
        method="dqn",
        warmup_steps=WARMUP,
        recent_steps=WARMUP,
        updates_per_step=args.updates,
        batch_size=BATCH,
        replay_steps=args.capacity,
        refresh_every=args.steps,
        eval_every=args.steps,
        eval_episodes=1,
    )
    trainer = make_trainer(CartPole(), config)
    state = jax.jit(trainer.init)(jax.random.key(0), TASK, HPARAMS)
    carry = jax.jit(trainer.warmup, donate_argnums=0)(state, Clock.start(), HPARAMS)
    timing, _ = _measure.time_calls(trainer.chunk, carry, HPARAMS, repeats=args.repeats)
    return timing.per(args.steps)


def time_rejax(args: Args) -> Timing:
    """The same of rejax's."""
    import gymnax
    from flax import linen
    from rejax.algos import DQN
    from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy

    env, params = gymnax.make("CartPole-v1")
    agent = EpsilonGreedyPolicy(DiscreteQNetwork)(hidden_layer_sizes=HIDDEN, action_dim=env.num_actions, activation=linen.relu)
    algorithm: Any = DQN.create(
        env=env,
        env_params=params,
        learning_rate=HPARAMS.learning_rate,
        gamma=HPARAMS.gamma,
        polyak=1.0 - HPARAMS.target_rate,
        num_epochs=args.updates,
        batch_size=BATCH,
        buffer_size=args.capacity,
        fill_buffer=WARMUP,
        eps_start=HPARAMS.epsilon_start,
        eps_end=HPARAMS.epsilon_end,
    ).replace(agent=agent)

    def train(state: Any, steps: int) -> Any:
        return jax.lax.fori_loop(0, steps, lambda _, state: algorithm.train_iteration(state), state)

    state = jax.jit(lambda key: train(algorithm.init_state(key), WARMUP))(jax.random.key(0))
    timing, _ = _measure.time_calls(lambda state, _: (train(state, args.steps), ()), (state,), None, repeats=args.repeats)
    return timing.per(args.steps)


def time_stable_baselines(args: Args) -> Timing:
    """The same of Stable-Baselines3's."""
    import torch
    from stable_baselines3 import DQN

    torch.set_num_threads(1)
    model = DQN(
        "MlpPolicy",
        "CartPole-v1",
        learning_rate=HPARAMS.learning_rate,
        gamma=HPARAMS.gamma,
        tau=HPARAMS.target_rate,
        target_update_interval=1,
        train_freq=1,
        gradient_steps=args.updates,
        batch_size=BATCH,
        buffer_size=args.capacity,
        learning_starts=WARMUP,
        exploration_initial_eps=HPARAMS.epsilon_start,
        exploration_final_eps=HPARAMS.epsilon_end,
        policy_kwargs={"net_arch": list(HIDDEN)},
        seed=0,
        device="cpu",
    )

    def run(steps: int) -> float:
        began = time.perf_counter()
        model.learn(steps, reset_num_timesteps=False)
        return time.perf_counter() - began

    run(WARMUP)
    run(args.steps)
    return Timing(tuple(run(args.steps) for _ in range(args.repeats)), 0.0).per(args.steps)


SIDES: Mapping[str, Callable[[Args], Timing]] = {
    "ours": time_ours,
    "rejax": time_rejax,
    "Stable-Baselines3": time_stable_baselines,
}
"""By the name in the table what times an environment step with its updates; ours first."""


def table(results: Mapping[str, Timing], updates: int) -> str:
    """Steps per second, and what ours are to the others'."""
    ours = results["ours"].median
    rows = [
        [name, step.rate(), _measure.number(step.median / ours), f"{step.compile_seconds:.1f}"]
        for name, step in results.items()
    ]
    header = ["DQN on CartPole", f"environment steps per second, {updates} updates each", "ours against", "compile, s"]
    return _measure.table(header, rows)


if __name__ == "__main__":
    exit_with(main)
