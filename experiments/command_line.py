"""The command line of `experiments.train`, read into what is computed and how."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from apt_jax.config import HParams
from experiments import lanes
from experiments.errors import UsageError
from experiments.presets import Preset, starting_point
from experiments.settings import Experiment, Session, check, load, target_path

Values: Any = lanes.values_type()


@dataclass(frozen=True)
class _Basis:
    """The options that decide the defaults of all others."""

    run_dir: Path | None = None
    resume: bool = False
    preset: Preset | None = None
    method: str | None = None
    config_method: Annotated[str | None, tyro.conf.arg(name="config.method")] = None
    space: str = Experiment.space
    target: str | None = None


def parse(args: Sequence[str] | None = None) -> tuple[Experiment, Session]:
    """The command line; each option's default is the saved run's when resuming, else `starting_point`'s.

    Raises:
      UsageError: options that contradict each other or the saved run.
    """
    args = sys.argv[1:] if args is None else list(args)
    basis, _ = tyro.cli(_Basis, args=args, add_help=False, return_unknown_args=True)
    saved = load(basis.run_dir) if basis.resume and basis.run_dir else None
    default = saved or Experiment()
    if basis.preset or not saved:
        space = saved.space if saved else basis.space
        method = basis.method or basis.config_method or default.config.method
        config, hparams = starting_point(basis.preset or "fast", space, method)
        default = dataclasses.replace(default, config=config, hparams=hparams)

    def train(
        session: Annotated[Session, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff],
        experiment: Annotated[Experiment, tyro.conf.arg(name="")] = dataclasses.replace(default, hparams=HParams()),  # noqa: B008
        hparams: Values = Values(**lanes.to_values(default.hparams)),  # noqa: B008
    ) -> tuple[Experiment, Session]:
        """Train a method on one target task, all seeds in one compiled program.

        Several values of one of the hparams are a sweep: every combination runs with every seed, in the same program.
        """
        return dataclasses.replace(experiment, hparams=lanes.from_values(dataclasses.asdict(hparams))), session

    experiment, session = tyro.cli(train, args=args, prog="python -m experiments.train")
    if session.method:
        experiment = dataclasses.replace(experiment, config=dataclasses.replace(experiment.config, method=session.method))
    if not saved or basis.target:
        file = target_path(experiment.space, experiment.target)  # named again, it may not be what the run has kept of it
        kept = saved.target_file if saved and saved.target == experiment.target else None
        experiment = dataclasses.replace(experiment, target_file=file or kept)
    check(experiment, session)
    if saved:
        check_resumable(saved, experiment)
    return experiment, session


def check_resumable(saved: Experiment, asked: Experiment) -> None:
    """Raises a `UsageError` that names every difference; only `env_steps` may grow."""
    if asked.env_steps < saved.env_steps:
        raise UsageError(f"--env-steps may only grow on --resume: saved {saved.env_steps}, asked {asked.env_steps}")
    old, new = _comparable(saved), _comparable(asked)
    differing = [f"{name} (saved {old[name]}, asked {new[name]})" for name in old if old[name] != new[name]]
    if differing:
        raise UsageError(f"--resume must keep what the run was started with; it differs in {', '.join(differing)}")


def _comparable(experiment: Experiment) -> dict[str, Any]:
    """Every field under its option's name, the target file by its content; without `env_steps`."""
    fields = dataclasses.asdict(experiment)
    del fields["env_steps"]
    config, hparams = fields.pop("config"), fields.pop("hparams")
    if experiment.target_file:
        fields |= {"target": "of a file", "target_file": _read(experiment.target_file)}
    return {
        **fields,
        **{f"config.{name}": value for name, value in config.items()},
        **{f"hparams.{name}": value for name, value in hparams.items()},
    }


def _read(file: Path) -> str:
    """The text of a file; raises a `UsageError` where there is none."""
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{file} cannot be read as text: {error}") from error
