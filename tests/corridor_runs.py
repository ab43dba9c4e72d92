"""Training runs on the corridor, from the command line: `python -m tests.corridor_runs OPTIONS` is `experiments.train OPTIONS`."""

from __future__ import annotations

import shlex
import sys

import numpy as np

import envs
from experiments import pictures, train
from tests.corridor import Corridor

OPTIONS = shlex.split(
    """--space corridor --target far --method random --seeds 3 0 5 --config.warmup-steps 40 --config.eval-every 20
    --config.refresh-every 20 --config.replay-steps 60 --config.recent-steps 20 --config.replay-episodes 8 --config.return-window 8
    --config.updates-per-step 1 --config.batch-size 4 --config.eval-episodes 2 --config.probe-tasks 2"""
)


class Space(Corridor):
    """With what the scripts want of a space beyond training."""

    targets = {"far": "7"}

    def parse_target(self, text):
        return np.int32(text)


def register():
    """Makes the space known by name, and leaves out the pictures, which cost more than such a run."""
    envs.SPACES["corridor"] = Space
    pictures.draw = lambda *_: None


if __name__ == "__main__":
    register()
    sys.exit(train.main())
