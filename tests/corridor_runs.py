"""Training runs on the corridor without pictures: `python -m tests.corridor_runs ...` is `experiments.train ...`."""

from __future__ import annotations

import os
import shlex
import signal
import sys

import envs
from experiments import compare, pictures, train
from experiments.examples.corridor import Corridor
from experiments.run_dir import RunDir

OPTIONS = shlex.split(
    """--space corridor --preset paper --seeds 3 0 5 1 2 4 6 7 8 --env-steps 440 --config.warmup-steps 40 --config.eval-every 20
    --config.refresh-every 20 --config.replay-steps 60 --config.recent-steps 20 --config.replay-episodes 8
    --config.return-window 8 --config.updates-per-step 1 --config.batch-size 4 --config.eval-episodes 2
    --config.probe-tasks 2 --checkpoint-every 100 --devices 2"""
)


def register():
    """Makes the space known by its name, and leaves out the pictures, which cost more than such a run."""
    envs.SPACES["corridor"] = Corridor
    pictures.draw = lambda *_: None


def make_and_be_killed_once(experiment, session):
    """A job whose process is killed between two checkpoints, the first time that it gets there."""
    register()
    marker = session.run_dir.with_suffix(".killed")
    append = RunDir.append_metrics

    def append_and_die(run, env_steps, *rest):
        append(run, env_steps, *rest)
        if env_steps == 260 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    RunDir.append_metrics = append_and_die
    return compare.make_alone(experiment, session)


if __name__ == "__main__":
    register()
    sys.exit(train.main())
