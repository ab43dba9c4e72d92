"""How far a run is: a live table on a terminal, one line per evaluation elsewhere."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import timedelta
from types import TracebackType
from typing import Protocol

import numpy as np
from jaxtyping import Float
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from experiments import processes
from experiments.sinks import Metrics

COLUMNS = {"target_return": "target return", "generated_episode_return": "generated return", "beta": "beta"}
"""The metrics shown, as far as a method has them."""


class View(Protocol):
    """What the training loop tells about itself."""

    def __enter__(self) -> View: ...

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None: ...

    def note(self, text: str) -> None:
        """A line that stays."""
        ...

    def start(self, env_steps: int) -> None:
        """Training begins here; the pace is measured from now."""
        ...

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """The latest evaluation."""
        ...

    def stop(self) -> None:
        """No more live display; notes still appear."""
        ...


class Pace:
    """Environment steps per second since the start, and the time left at that pace."""

    def __init__(self, env_steps: int, total: int):
        self._first, self._total, self._began = env_steps, total, time.monotonic()

    def describe(self, env_steps: int) -> str:
        """For example `1,234 steps/s, 0:05:12 left`."""
        rate = (env_steps - self._first) / max(time.monotonic() - self._began, 1e-9)
        if not rate:
            return "starting"
        return f"{rate:,.0f} steps/s, {timedelta(seconds=round((self._total - env_steps) / rate))} left"


class LiveView:
    """A bar and a table of lanes that redraw in place."""

    def __init__(self, lanes: Sequence[str], total: int, console: Console):
        self._lanes, self._total = lanes, total
        self._bar = Progress(TextColumn("steps"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[pace]}"))
        self._task = self._bar.add_task("steps", total=total, pace="preparing")
        self._pace = Pace(0, total)
        self._live = Live(self._bar, console=console, refresh_per_second=4)

    def __enter__(self) -> LiveView:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        self._live.stop()

    def note(self, text: str) -> None:
        """Above the live part."""
        self._live.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def start(self, env_steps: int) -> None:
        """Starts the clock of the pace."""
        self._pace = Pace(env_steps, self._total)
        self._bar.update(self._task, completed=env_steps, pace="first chunk")

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """Redraws bar and table."""
        self._bar.update(self._task, completed=env_steps, pace=self._pace.describe(env_steps))
        self._live.update(Group(self._bar, _table(self._lanes, metrics)))

    def stop(self) -> None:
        """Leaves the last state on the terminal."""
        self._live.stop()


class PlainView:
    """One line per evaluation, for logs."""

    def __init__(self, total: int):
        self._total, self._pace = total, Pace(0, total)

    def __enter__(self) -> PlainView:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        pass

    def note(self, text: str) -> None:
        """A line."""
        print(text, flush=True)

    def start(self, env_steps: int) -> None:
        """Starts the clock of the pace."""
        self._pace = Pace(env_steps, self._total)

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """Steps, pace and the mean over lanes of each shown metric."""
        values = [f"{title} {_mean(metrics[name]):.3f}" for name, title in COLUMNS.items() if name in metrics]
        self.note(f"{env_steps:,}/{self._total:,} steps, {self._pace.describe(env_steps)} | " + ", ".join(values))

    def stop(self) -> None:
        """Nothing to stop."""


class Silence:
    """Nothing, because another process tells it."""

    def __enter__(self) -> Silence:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        pass

    def note(self, text: str) -> None:
        """Not here."""

    def start(self, env_steps: int) -> None:
        """Not here."""

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """Not here."""

    def stop(self) -> None:
        """Nothing to stop."""


def make_view(lanes: Sequence[str], total: int) -> View:
    """Live on a terminal, plain elsewhere; silent in all processes but the first."""
    if not processes.is_first():
        return Silence()
    console = Console()
    return LiveView(lanes, total, console) if console.is_terminal else PlainView(total)


def _table(lanes: Sequence[str], metrics: Metrics) -> Table:
    names = [name for name in COLUMNS if name in metrics]
    table = Table("", *(COLUMNS[name] for name in names))
    for column in table.columns:
        column.justify = "right"
    for i, lane in enumerate(lanes):
        table.add_row(lane, *(f"{metrics[name][i]:.3f}" for name in names))
    table.add_section()
    table.add_row("mean", *(f"{_mean(metrics[name]):.3f}" for name in names))
    return table


def _mean(values: Float[np.ndarray, "S"]) -> float:
    """Over the lanes that have a value, NaN if none has: a lane may not have finished an episode yet."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan
