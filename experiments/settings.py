"""What a training run is asked to do, and the part of it that a run directory remembers."""

from __future__ import annotations

import dataclasses
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

import envs
from apt_jax.config import Config, HParams, check_hparams
from apt_jax.lanes import Layout
from experiments import lanes, run_dir
from experiments.errors import UsageError
from experiments.presets import Preset

SinkName = Literal["tensorboard", "wandb"]

MOST_DEVICES = 1_024
"""Of a host's CPU; so many take minutes to start."""


@dataclass(frozen=True)
class Experiment:
    """What is computed; saved in the run directory, and what a resumed run has to agree with.

    Attributes:
      space: the task space: grid_world, manipulation, or manipulation_sawyer.
      target: the target task's name in the space, or a file that describes it.
      target_file: the file that `target` is, if it is one; of a run, what the run directory has kept of it.
      seeds: random seeds, trained side by side; each runs every combination of swept hyper-parameters.
      env_steps: environment steps of each seed, of all sources together, warm-up included: `warmup_steps` and a multiple of
        `eval_every`.
      plugins: Python modules to import first, which may add methods of their own to those that come with apt_jax.
      config: sizes and names; a change compiles a new program.
      hparams: numbers; a field may hold a tuple of values, all of which are run.
    """

    space: str = "grid_world"
    target: str = "A"
    target_file: tyro.conf.Suppress[Path | None] = None
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    env_steps: int = 100_000
    plugins: tuple[str, ...] = ()
    config: Config = dataclasses.field(default_factory=Config)
    hparams: tyro.conf.Suppress[HParams] = dataclasses.field(default_factory=HParams)

    @property
    def lanes(self) -> tuple[lanes.Lane, ...]:
        """What runs side by side."""
        return lanes.expand(self.seeds, self.hparams)


@dataclass(frozen=True)
class Session:
    """How it is computed; may differ when a run is resumed.

    Attributes:
      run_dir: where everything is written; must be new, empty, or resumed.
      resume: continue the run in the run directory; what it computes needs no repeating; layout, devices, sinks,
        checkpoint_every and what says that there are several processes do.
      preset: where config and hparams start from: fast (the default) or paper; a resumed run keeps its own. The space's own
        discount comes on top and, with fast, what was tuned for the method. Other options override single fields.
      method: short for --config.method: apt_gen, apt_gen_progress_only, apt_gen_return_only, random, alp_gmm, goal_gan, dqn,
        icm, rnd, ride, or one with a bonus added as in "apt_gen+rnd".
      layout: how the lanes of one device are laid out; by default map on CPU and vmap on accelerators.
      devices: devices the host CPU counts as, by default one per core; lanes are spread over them.
      distributed: this is one of several processes, each started with the same options, that share lanes and run directory; on
        SLURM, Open MPI, Kubernetes and TPU pods they find each other, elsewhere with the next three options.
      coordinator_address: host and port at which the first process can be reached.
      num_processes: how many processes there are.
      process_id: which one this is, from 0.
      sinks: also log to these: tensorboard (in the run directory), wandb (project apt-jax).
      checkpoint_every: environment steps between checkpoints.
    """

    run_dir: Path
    resume: bool = False
    preset: Preset | None = None
    method: str | None = None
    layout: Layout = "auto"
    devices: int | None = None
    distributed: bool = False
    coordinator_address: str | None = None
    num_processes: int | None = None
    process_id: int | None = None
    sinks: tuple[SinkName, ...] = ()
    checkpoint_every: int = 10_000

    @property
    def resume_command(self) -> str:
        """What to type to go on in the same way; the experiment itself is in the run directory."""
        words = ["python", "-m", "experiments.train", "--run-dir", str(self.run_dir), "--resume"]
        default = Session(self.run_dir)
        decided = ("run_dir", "resume", "preset", "method")
        for name in (field.name for field in dataclasses.fields(self) if field.name not in decided):
            value = getattr(self, name)
            if value != getattr(default, name):
                words.append(f"--{name.replace('_', '-')}")
                words += [] if value is True else map(str, value if isinstance(value, tuple) else [value])
        return shlex.join(words)


def make_space(name: str) -> envs.BenchmarkSpace:
    """The task space called `name`; raises a `UsageError` if there is none, or this machine lacks what it needs."""
    try:
        return envs.make(name)
    except ValueError as error:
        raise UsageError(str(error)) from error


def target_path(space: str, target: str) -> Path | None:
    """The file that `target` is, if it is one and no target of the space has this name."""
    if not Path(target).is_file() or (space in envs.SPACES and target in make_space(space).targets):
        return None
    return Path(target)


def check(experiment: Experiment, session: Session) -> None:
    """Raises a `UsageError` for what can be told wrong without the task space."""
    if not experiment.seeds or len(set(experiment.seeds)) != len(experiment.seeds):
        raise UsageError(f"--seeds needs one or more different numbers, got {' '.join(map(str, experiment.seeds)) or 'none'}")
    for seed in experiment.seeds:
        check_seed(seed, "--seeds")
    if experiment.target_file and not experiment.target_file.is_file():
        raise UsageError(f"{experiment.target_file} is no file")
    for name, values in lanes.swept(experiment.hparams).items():
        if not values or len(set(values)) != len(values):
            given = " ".join(f"{value:g}" for value in values) or "none"
            raise UsageError(f"--hparams.{name} needs one or more different numbers, got {given}")
    for lane in experiment.lanes:
        try:
            check_hparams(lane.hparams)
        except ValueError as error:
            raise UsageError(f"--hparams: {error}") from error
    if session.devices is not None and not 1 <= session.devices <= MOST_DEVICES:
        raise UsageError(f"--devices must be from 1 to {MOST_DEVICES:,}, got {session.devices}")
    if session.checkpoint_every < 1:
        raise UsageError(f"--checkpoint-every must be at least 1, got {session.checkpoint_every}")
    check_processes(session)


def check_seed(seed: int, option: str = "--seed") -> None:
    """Raises a `UsageError` for what is no random seed."""
    if not 0 <= seed < 2**31:
        raise UsageError(f"{option} must lie in [0, 2^31), got {seed}")


def check_processes(session: Session) -> None:
    """Raises a `UsageError` for processes that cannot find each other."""
    address, count, own = session.coordinator_address, session.num_processes, session.process_id
    given = [value for value in (address, count, own) if value is not None]
    if given and not session.distributed:
        raise UsageError("--coordinator-address, --num-processes and --process-id need --distributed")
    if address is not None and not re.fullmatch(r".+:\d+", address):
        raise UsageError(f"--coordinator-address must be a host and a port as in node1:1234, got {address}")
    if count is not None and count < 1:
        raise UsageError(f"--num-processes must be at least 1, got {count}")
    if own is not None and not 0 <= own < (count or own + 1):
        raise UsageError(f"--process-id must be from 0 to --num-processes less 1, got {own} of {count}")


def load(directory: Path) -> Experiment:
    """The experiment of a run directory.

    Raises:
      UsageError: no run there, or one that this version cannot read.
    """
    saved = run_dir.read_config(directory)
    try:
        return Experiment(
            **{
                **saved,
                "target_file": directory / saved["target_file"] if saved["target_file"] else None,
                "seeds": tuple(saved["seeds"]),
                "plugins": tuple(saved.get("plugins", ())),
                "config": Config(**saved["config"]),
                "hparams": HParams(**{name: _numbers(value) for name, value in saved["hparams"].items()}),
            }
        )
    except (KeyError, TypeError) as error:
        raise UsageError(f"{directory} was written by another version: {error}") from error


def _numbers(saved: Any) -> Any:
    """A number or several, as they come out of JSON."""
    return tuple(map(float, saved)) if isinstance(saved, list) else float(saved)


def target_name(experiment: Experiment) -> str:
    """What to call the target in a title."""
    return experiment.target_file.name if experiment.target_file else experiment.target
