"""The files of one run.

* config.json: the experiment, enough to resume it
* metrics.csv: one row per lane and evaluation; the columns before `env_steps` (seed, swept hyper-parameters) name the lane
* summary.json: results, times, versions
* checkpoints/: the latest state (orbax)
* tasks/: generated task parameters over time, one npz per sampled step, leaves [lanes, tasks, ...], and a picture per lane
* pictures
* lock: held by the process that writes
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from jaxtyping import Float, Int

from apt_jax.specs import Params
from experiments.errors import UsageError

Curves = dict[str, Float[np.ndarray, "L T"]]
"""Metrics by name: one row per lane, one column per evaluation."""


class RunDir:
    """A run directory that this process writes to."""

    def __init__(self, path: Path):
        self.path = path
        self._lock = FileLock(path / "lock")

    def create(self, config: Mapping[str, Any], target_file: Path | None) -> None:
        """Begins a new run; `target_file` is copied in, so that the directory stands alone.

        Raises:
          UsageError: the directory holds something already, or cannot be made.
        """
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise UsageError(f"{self.path} is not empty; pass --resume to go on with the run in it, or another --run-dir")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--run-dir {self.path} cannot be made: {error}") from error
        self.hold()
        if target_file:
            shutil.copyfile(target_file, self.path / f"target{target_file.suffix}")
            config = {**config, "target_file": f"target{target_file.suffix}"}
        self.write_json("config.json", config)

    def hold(self) -> None:
        """Keeps other processes from writing to it until `release`, or the end of this one.

        Raises:
          UsageError: another one does.
        """
        try:
            self._lock.acquire(timeout=0)
        except NotImplementedError:  # a shared disk that knows no locks
            return
        except Timeout as error:
            raise UsageError(f"another process is at work on {self.path}; wait for it, or take another --run-dir") from error

    def release(self) -> None:
        """Lets others write to it."""
        self._lock.release()

    @property
    def checkpoints(self) -> Path:
        """Where `apt_jax.checkpoint` writes."""
        return self.path / "checkpoints"

    @property
    def has_results(self) -> bool:
        """Whether anything was learned; a checkpoint comes before the first row."""
        return bool(_read_rows(self.path))

    def rewind(self, env_steps: int) -> None:
        """Drops what was written after a checkpoint's step, so that a resumed run writes it once."""
        metrics = self.path / "metrics.csv"
        with _naming(metrics):
            rows = [row for row in _read_rows(self.path) if int(row["env_steps"]) <= env_steps]
        if rows:
            _write_rows(metrics.with_suffix(".tmp"), rows, mode="w")
            metrics.with_suffix(".tmp").replace(metrics)
        else:
            metrics.unlink(missing_ok=True)
        for step, file in task_files(self.path).items():
            if step > env_steps:
                file.unlink()

    def append_metrics(
        self,
        env_steps: int,
        wall_seconds: float,
        lanes: Sequence[Mapping[str, float]],
        metrics: Mapping[str, Float[np.ndarray, "L"]],
    ) -> None:
        """One row per lane, named by the columns in `lanes`."""
        rows = [
            {**lane, "env_steps": env_steps, "wall_seconds": f"{wall_seconds:.2f}"}
            | {name: str(values[i]) for name, values in sorted(metrics.items())}
            for i, lane in enumerate(lanes)
        ]
        _write_rows(self.path / "metrics.csv", rows, mode="a")

    def write_tasks(self, env_steps: int, w: Params) -> None:
        """Generated task parameters, leaves [lanes, tasks, ...]."""
        (self.path / "tasks").mkdir(exist_ok=True)
        arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in w.items()}
        np.savez_compressed(self.path / "tasks" / f"{env_steps:010d}.npz", **arrays)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file whole or not at all."""
        temporary = self.path / f"{name}.tmp"
        temporary.write_text(json.dumps(_finite(content), indent=2, default=str, allow_nan=False) + "\n")
        temporary.replace(self.path / name)


def _finite(content: Any) -> Any:
    """JSON knows neither infinity nor NaN: they become strings, which `float` reads."""
    match content:
        case Mapping():
            return {name: _finite(value) for name, value in content.items()}
        case list() | tuple():
            return [_finite(value) for value in content]
        case float() if not math.isfinite(content):
            return str(content)
        case _:
            return content


def read_config(path: Path) -> dict[str, Any]:
    """The content of config.json.

    Raises:
      UsageError: no run in that directory, or a damaged file.
    """
    file = path / "config.json"
    if not file.is_file():
        raise UsageError(f"{path} holds no run (no config.json)")
    with _naming(file):
        content: dict[str, Any] = json.loads(file.read_text())
    return content


def read_metrics(path: Path) -> tuple[Int[np.ndarray, "T"], Curves]:
    """The environment steps of every evaluation that is there for all lanes, and the metrics with the lanes' own columns.

    Raises:
      UsageError: no such directory, no evaluation in it yet, or damaged metrics.
    """
    if not path.is_dir():
        raise UsageError(f"{path} is no directory")
    rows = _read_rows(path)
    with _naming(path / "metrics.csv"):
        lanes = len({tuple(row[name] for name in _lane_columns(rows)) for row in rows})
        rows = rows[: len(rows) - len(rows) % max(lanes, 1)]
        if not rows:
            raise UsageError(f"{path} holds no evaluation yet (no rows in metrics.csv)")
        columns = {name: np.array([float(row[name]) for row in rows]).reshape(-1, lanes).T for name in rows[0]}
    env_steps = columns.pop("env_steps")
    if (env_steps != env_steps[0]).any() or (np.diff(env_steps[0]) <= 0).any():
        raise UsageError(f"{path / 'metrics.csv'} is damaged: its rows are not one of each lane at each evaluation, in order")
    return env_steps[0].astype(int), columns


def read_settings(path: Path) -> dict[str, tuple[Int[np.ndarray, "T"], Curves]]:
    """Like `read_metrics`, the lanes of each combination of swept hyper-parameters apart, by its name ("" without a sweep)."""
    env_steps, curves = read_metrics(path)
    columns = [name for name in _lane_columns(_read_rows(path)) if name != "seed"]
    names = [", ".join(f"{name} {curves[name][i, 0]:.10g}" for name in columns) for i in range(len(curves["seed"]))]
    lanes = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    return {name: (env_steps, {metric: values[own] for metric, values in curves.items()}) for name, own in lanes.items()}


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Says which file it was where one cannot be read."""
    try:
        yield
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} is damaged: {error}") from error


def _lane_columns(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """What names a lane: the columns before `env_steps`."""
    names = list(rows[0]) if rows else ["env_steps"]
    return names[: names.index("env_steps")]


def wall_seconds(path: Path) -> float:
    """How long the run took until its last evaluation."""
    rows = _read_rows(path)
    return float(rows[-1]["wall_seconds"]) if rows else 0.0


def task_files(path: Path) -> dict[int, Path]:
    """Sampled task parameters by environment step, in order."""
    return {int(file.stem): file for file in sorted((path / "tasks").glob("*.npz"))}


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of metrics.csv; what a killed process has left of an unfinished line is not one."""
    file = path / "metrics.csv"
    if not file.exists():
        return []
    lines = file.read_text().splitlines(keepends=True)
    return list(csv.DictReader(line for line in lines if line.endswith("\n")))


def _check_header(file: Path, names: Sequence[str]) -> None:
    """Raises a `UsageError` unless those are the columns of a file."""
    with file.open(newline="") as stream:
        header = next(csv.reader(stream))
    if header != list(names):
        different = ", ".join(sorted({*header} ^ {*names})) or "in another order"
        raise UsageError(
            f"{file} has other columns ({different}): another version began it; go on with that one, or in another --run-dir"
        )


def _write_rows(file: Path, rows: Sequence[Mapping[str, object]], mode: str) -> None:
    names = list(rows[0])
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, fieldnames=names)
    with file.open(f"{mode}b", buffering=0) as stream:
        if stream.tell() == 0:
            writer.writeheader()
        else:
            _check_header(file, names)
        writer.writerows(rows)
        stream.write(text.getvalue().encode())  # in one go: a process that is killed leaves all lanes' rows or none
        os.fsync(stream.fileno())
