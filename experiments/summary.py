"""The results of a run in one file."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments import run_dir, runtime
from experiments.settings import Experiment


@dataclass
class Times:
    """Where the seconds of one session went.

    Attributes:
      before: wall seconds of earlier sessions of the same run, until the checkpoint.
      compile: ahead-of-time compilation of init, warm-up and chunk.
      training: chunks, and nothing else.
      trained_steps: environment steps of one lane in these chunks.
      about: versions, device and commit, as they are when the session starts.
    """

    before: float
    compile: float = 0.0
    training: float = 0.0
    trained_steps: int = 0
    about: dict[str, object] = field(default_factory=runtime.describe)
    _began: float = field(default_factory=time.monotonic)

    @property
    def wall(self) -> float:
        """Wall seconds of all sessions until now."""
        return self.before + time.monotonic() - self._began

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps of one lane, None before the first chunk."""
        return self.trained_steps / self.training if self.training else None


def summarise(path: Path, experiment: Experiment, times: Times) -> dict[str, object]:
    """The content of summary.json for a run directory with at least one evaluation."""
    env_steps, curves = run_dir.read_metrics(path)
    speed = times.steps_per_second
    return {
        "env_steps": int(env_steps[-1]),
        "lanes": [
            {
                **lane.index,
                "final_target_return": _number(curves["target_return"][i, -1]),
                "final_target_return_raw": _number(curves["target_return_raw"][i, -1]),
                "best_target_return": _number(curves["target_return_raw"][i].max()),
            }
            for i, lane in enumerate(experiment.lanes)
        ],
        "mean_final_target_return": _number(curves["target_return"][:, -1].mean()),
        "wall_seconds": round(times.wall, 2),
        "compile_seconds": round(times.compile, 2),
        "steps_per_second_per_lane": speed and round(speed, 1),
        "steps_per_second_all_lanes": speed and round(speed * len(experiment.lanes), 1),
        **times.about,
    }


def is_complete(path: Path, experiment: Experiment) -> bool:
    """Whether a run directory has the results of all steps; the summary is written last, and anew if it is damaged."""
    try:
        return int(json.loads((path / "summary.json").read_text())["env_steps"]) >= experiment.env_steps
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return False


def _number(value: np.floating) -> float | None:
    """JSON has no NaN."""
    return float(value) if np.isfinite(value) else None
