"""Pictures of a run, drawn from its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.run_dir import Curves

Image = UInt8[np.ndarray, "H W 3"]
Run = tuple[Int[np.ndarray, "T"], Curves]
"""Environment steps of the evaluations, and the metrics then."""
Block = tuple[str, Mapping[str, Run], str]
"""A title, runs by name, and the metric of theirs to show."""

PANELS = {
    "target_return": "Return on the target",
    "target_return_raw": "The same before the restore rule",
    "generated_episode_return": "Return on generated tasks",
    "beta": "Beta",
    "probe_solution_length": "Shortest solution of generated tasks",
}
"""The metrics drawn, as far as a method and a task space have them."""

_TITLES = PANELS | {
    "generator_return": "What the generator expects them to return",
    "v1_correlation": "V1's correlation with progress",
    "v2_correlation": "V2's correlation with return",
}

TOGETHER = 6
"""How many runs can be told apart in one panel."""

NAMED = 10
"""How many seeds are named in a legend; more are drawn without."""

_MEAN_COLOUR = "black"
_TARGET_COLOUR = "tab:green"


def learning_curves(file: Path, settings: Mapping[str, Run], *, delta: float | None, title: str) -> None:
    """One panel per metric: every seed thin, their mean thick, in a colour per setting of swept hyper-parameters.

    Args:
      settings: by name, which is "" if nothing is swept.
      delta: the generated return that beta steers to, None if that differs.
    """
    single = len(settings) == 1
    curves = next(iter(settings.values()))[1]
    named = len(curves["seed"]) <= NAMED
    names = [name for name in PANELS if name in curves]
    across = min(3, len(names))
    down = -(-len(names) // across)
    figure = Figure(figsize=(4.2 * across, 3.2 * down + 0.6), layout="constrained")
    grid = list(figure.subplots(down, across, squeeze=False).flat)
    for axes in grid[len(names) :]:
        axes.set_visible(False)
    for axes, name in zip(grid, names, strict=False):
        for index, (setting, (env_steps, curves)) in enumerate(settings.items()):
            for seed, values in zip(curves["seed"][:, 0], curves[name], strict=True):
                style: dict[str, Any] = {"label": f"seed {seed:.10g}" if named else None} if single else {"color": f"C{index}"}
                axes.plot(env_steps, values, marker=".", markersize=3, linewidth=1, alpha=0.6 if single else 0.25, **style)
            mean = np.ma.masked_invalid(curves[name]).mean(axis=0)
            colour = _MEAN_COLOUR if single else f"C{index}"
            axes.plot(env_steps, mean, color=colour, linewidth=2, label="mean" if single else setting)
        _decorate(axes, name)
        if name == "generated_episode_return" and "beta" in curves and delta is not None:
            _mark(axes, delta, "delta")
    handles = figure.axes[0].get_legend_handles_labels()
    _legend(figure, *handles)
    figure.suptitle(title)
    figure.savefig(file, dpi=150)


def comparison(file: Path, panels: Mapping[str, Mapping[str, Run]], *, metrics: Sequence[str] = ("target_return",)) -> None:
    """Metrics of several runs, by panel and name: every seed thin, their mean thick.

    Up to `TOGETHER` names share a panel, with the same colour in every panel; of more, each has a small one to itself.  A run
    that lacks a metric is left out there.
    """
    names = list(dict.fromkeys(name for runs in panels.values() for name in runs))
    blocks = [
        (title, {name: run for name, run in runs.items() if metric in run[1]}, metric)
        for title, runs in panels.items()
        for metric in metrics
    ]
    figure = _together(blocks, names) if len(names) <= TOGETHER else _apart(blocks)
    figure.savefig(file, dpi=150)


def _together(blocks: Sequence[Block], names: Sequence[str]) -> Figure:
    """A panel per block, side by side, a colour per name."""
    count = len(blocks)
    width = 7 if count == 1 else 5 * count
    legend_height = 0.25 * -(-len(names) // _legend_columns(names, width))
    figure = Figure(figsize=(width, 4 + legend_height), layout="constrained")
    handles = {}
    for axes, (title, runs, metric) in zip(np.atleast_1d(figure.subplots(1, count)), blocks, strict=True):
        for name, run in runs.items():
            handles[name] = _seeds_and_mean(axes, run, metric, f"C{names.index(name)}")
        _decorate(axes, metric)
        if title:
            axes.set_ylabel(axes.get_title())
            axes.set_title(title, fontsize="medium")
    _legend(figure, list(handles.values()), list(handles))
    return figure


def _legend(figure: Figure, handles: Sequence[Artist], names: Sequence[str]) -> None:
    """Below everything else, in as many columns as there is room for."""
    columns = _legend_columns(names, figure.get_figwidth())
    figure.legend(handles, names, loc="outside lower center", ncols=columns, fontsize="small")


def _legend_columns(names: Sequence[str], width: float) -> int:
    """How many columns of a legend in small print fit a width in inches."""
    column = 0.6 + 0.075 * max(map(len, names))
    return max(1, min(len(names), int(width / column)))


def _apart(blocks: Sequence[Block]) -> Figure:
    """Block below block, in each a small panel per run, all with the same axes."""
    across = min(5, max(len(runs) for _, runs, _ in blocks))
    downs = [max(1, -(-len(runs) // across)) for _, runs, _ in blocks]
    figure = Figure(figsize=(2.3 * across, 1.9 * sum(downs) + 0.4 * len(blocks)), layout="constrained")
    parts = figure.subfigures(len(blocks), 1, height_ratios=downs, squeeze=False).flat
    for part, (title, runs, metric), down in zip(parts, blocks, downs, strict=True):
        part.suptitle(", ".join(filter(None, (_TITLES.get(metric, metric), title))), fontsize="medium")
        grid = list(part.subplots(down, across, sharex=True, sharey=True, squeeze=False).flat)
        for axes in grid[len(runs) :]:
            axes.set_visible(False)
        for axes, run in zip(grid, runs.values(), strict=False):
            _seeds_and_mean(axes, run, metric, "C0")
        for index, (axes, name) in enumerate(zip(grid, runs, strict=False)):
            _decorate(axes, metric)
            axes.set_title(name, fontsize="small")
            below = index + across < len(runs)
            axes.tick_params(labelbottom=not below)
            axes.set_xlabel("" if below else axes.get_xlabel(), fontsize="small")
    return figure


def _seeds_and_mean(axes: Axes, run: Run, metric: str, colour: str) -> Line2D:
    """Every seed thin, their mean thick; returns the mean's line."""
    env_steps, curves = run
    values = np.ma.masked_invalid(curves[metric])
    for own in values:
        axes.plot(env_steps, own, color=colour, linewidth=0.8, alpha=0.4)
    (line,) = axes.plot(env_steps, values.mean(axis=0), color=colour, linewidth=2.5)
    return line


def _decorate(axes: Axes, name: str) -> None:
    axes.set_title(_TITLES.get(name, name), fontsize="medium")
    axes.set_xlabel("environment steps")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k")
    axes.grid(alpha=0.3)
    if name == "beta":
        axes.set_yscale("log", base=2)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    if "return" in name:  # at least from 0 to 1, so that noise around failure looks like noise
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.0), max(high, 1.0))


def _mark(axes: Axes, level: float, text: str) -> None:
    axes.axhline(level, color=_TARGET_COLOUR, linestyle="--", linewidth=1)
    box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    at = (0.01, level)
    axes.annotate(text, at, xycoords=("axes fraction", "data"), va="bottom", fontsize="small", color=_TARGET_COLOUR, bbox=box)


def progression(file: Path, boards: Mapping[int, Sequence[Image]], target: Image, *, rows: Sequence[str]) -> None:
    """Generated tasks over time, the target last with a green border.

    Args:
      boards: by environment step, one picture per row.
      rows: titles of the rows.
    """
    height = max(1.7 * target.shape[0] / target.shape[1] - 0.1, 0.5)
    figure = Figure(figsize=(1.7 * (len(boards) + 1), height * len(rows) + 0.3), layout="constrained")
    grid = figure.subplots(len(rows), len(boards) + 1, squeeze=False)
    for column, (env_steps, pictures) in enumerate(boards.items()):
        grid[0, column].set_title(f"{env_steps:,} steps", fontsize="small")
        for axes, picture in zip(grid[:, column], pictures, strict=True):
            _show(axes, picture)
    grid[0, -1].set_title("target", fontsize="small", color=_TARGET_COLOUR)
    for axes, title in zip(grid[:, 0], rows, strict=True):
        axes.set_ylabel(title, fontsize="small")
    for axes in grid[:, -1]:
        _show(axes, target)
        for spine in axes.spines.values():
            spine.set(color=_TARGET_COLOUR, linewidth=3, visible=True)
    figure.savefig(file, dpi=150)


def mosaic(file: Path, boards: Mapping[int, Sequence[Image]], *, title: str) -> None:
    """Samples of generated tasks over time, as one image: by environment step (columns), several pictures (rows)."""
    gap = 4
    padded = [
        [np.pad(board, ((0, gap), (0, gap), (0, 0)), constant_values=255) for board in column] for column in boards.values()
    ]
    image = np.concatenate([np.concatenate(column, axis=0) for column in padded], axis=1)
    width = padded[0][0].shape[1]
    margin = 0.6
    figure = Figure(figsize=(image.shape[1] / 100 + margin, image.shape[0] / 100 + margin), layout="constrained")
    axes = figure.subplots()
    _show(axes, image)
    axes.set_xticks(np.arange(len(boards)) * width + width / 2, [f"{step / 1000:g}k" for step in boards])
    axes.tick_params(length=0, labelsize="small")
    axes.set_title(title, fontsize="medium")
    figure.savefig(file, dpi=100)


def gallery(file: Path, pictures: Sequence[Image], *, columns: int) -> None:
    """Pictures in rows of `columns`."""
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(1.6 * columns, 1.6 * rows), layout="constrained")
    for axes, picture in zip(figure.subplots(rows, columns, squeeze=False).flat, pictures, strict=False):
        _show(axes, picture)
    figure.savefig(file, dpi=150)


def _show(axes: Axes, picture: Image) -> None:
    axes.imshow(picture)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)


def evenly(steps: Sequence[int], at_most: int) -> list[int]:
    """At most so many of the steps, evenly spread, first and last among them."""
    chosen = np.unique(np.linspace(0, len(steps) - 1, min(at_most, len(steps))).round().astype(int))
    return [steps[i] for i in chosen]
