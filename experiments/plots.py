"""Pictures of a run, drawn from its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.run_dir import Curves

Image = UInt8[np.ndarray, "H W 3"]
Run = tuple[Int[np.ndarray, "T"], Curves]
"""Environment steps of the evaluations, and the metrics then."""

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
    names = [name for name in PANELS if name in curves]
    figure = Figure(figsize=(4.2 * len(names), 3.6), layout="constrained")
    for axes, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        for index, (setting, (env_steps, curves)) in enumerate(settings.items()):
            for seed, values in zip(curves["seed"][:, 0], curves[name], strict=True):
                style: dict[str, Any] = {"label": f"seed {seed:g}"} if single else {"color": f"C{index}"}
                axes.plot(env_steps, values, marker=".", markersize=3, linewidth=1, alpha=0.6 if single else 0.25, **style)
            mean = np.ma.masked_invalid(curves[name]).mean(axis=0)
            colour = _MEAN_COLOUR if single else f"C{index}"
            axes.plot(env_steps, mean, color=colour, linewidth=2, label="mean" if single else setting)
        _decorate(axes, name)
        if name == "generated_episode_return" and "beta" in curves and delta is not None:
            _mark(axes, delta, "delta")
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=min(3 * len(names), 8), fontsize="small")
    figure.suptitle(title)
    figure.savefig(file, dpi=150)


def comparison(file: Path, panels: Mapping[str, Mapping[str, Run]], *, metrics: Sequence[str] = ("target_return",)) -> None:
    """Metrics of several runs, by panel and name: every seed thin, their mean thick.

    A name has the same colour in every panel; a run that lacks a metric is left out there.
    """
    names = list(dict.fromkeys(name for runs in panels.values() for name in runs))
    count = len(panels) * len(metrics)
    legend_columns = 3 * count
    legend_height = 0.25 * -(-len(names) // legend_columns)
    figure = Figure(figsize=(7 if count == 1 else 5 * count, 4 + legend_height), layout="constrained")
    handles = {}
    columns = [(title, runs, metric) for title, runs in panels.items() for metric in metrics]
    for axes, (title, runs, metric) in zip(np.atleast_1d(figure.subplots(1, count)), columns, strict=True):
        for name, (env_steps, curves) in runs.items():
            if metric not in curves:
                continue
            colour, values = f"C{names.index(name)}", np.ma.masked_invalid(curves[metric])
            for own in values:
                axes.plot(env_steps, own, color=colour, linewidth=0.8, alpha=0.4)
            (handles[name],) = axes.plot(env_steps, values.mean(axis=0), color=colour, linewidth=2.5)
        _decorate(axes, metric)
        if title:
            axes.set_title(title, fontsize="medium")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=legend_columns, fontsize="small")
    figure.savefig(file, dpi=150)


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
    axes.annotate(text, (0.99, level), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize="small")


def progression(file: Path, boards: Mapping[int, Sequence[Image]], target: Image, *, rows: Sequence[str]) -> None:
    """Generated tasks over time, the target last with a green border.

    Args:
      boards: by environment step, one picture per row.
      rows: titles of the rows.
    """
    height = 1.7 * target.shape[0] / target.shape[1] - 0.1
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
