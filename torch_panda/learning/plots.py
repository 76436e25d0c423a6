"""Plots of success curves: one panel per task, and one line per set of options.

A run is a folder with args.json and curve.csv. A line is the median over the seeds, and
a band shows the interquartile range, as in the panda-gym paper.

The legend names the algorithm and the options that differ from the preset. An entry
``label`` in args.json replaces the options by a name. Runs of one task and algorithm
that have the same name form one line.
"""

import csv
import json
import textwrap
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torch_panda.learning import files

Curve = list[dict[str, float]]
Metric = Literal["success", "ever_success", "return"]
COLUMNS = 3  # largest number of panels side by side
OFFLINE = ", offline"  # suffix of a title if the steps of the panel are gradient steps
LABEL_WIDTH = 56  # characters after which a label is wrapped
# Petroff's ten colours (arXiv 2107.02270), which colour-blind readers can tell apart.
# A panel with more lines repeats them.
COLORS = (
    *("#3f90da", "#ffa90e", "#bd1f01", "#94a4a2", "#832db6"),
    *("#a96b59", "#e76300", "#b9ac70", "#717581", "#92dadd"),
)

Lines = dict[str, list[Curve]]
"""The curves of all seeds, by the label of their algorithm and options."""


def plot_curve(curve: Curve, title: str, path: Path, *, xlabel: str) -> None:
    """Draw one run's success over steps; ``xlabel`` names the kind of steps."""
    figure = Figure(figsize=(5, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.plot([row["step"] for row in curve], [row["success"] for row in curve], "o-")
    _label(axes, title, "success", xlabel)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format that the ending of its file names.

    Raises:
        OSError: The file cannot be written.
        ValueError: There is no such format.
    """
    format = path.suffix.removeprefix(".")
    files.replace(path, lambda file: figure.savefig(file, dpi=120, format=format))


def plot_panels(runs: dict[str, Lines], metric: Metric, path: Path) -> None:
    """Draw median and interquartile range over seeds, in one panel for each task.

    Args:
        runs: Lines of each task.
        metric: Column of the curves to draw.
        path: Picture to write.

    Raises:
        OSError: The picture cannot be written.
        ValueError: The ending of its name is not a format.
    """
    width = min(COLUMNS, len(runs))
    height = -(-len(runs) // width)
    # Legends are below the panels.
    legend = 0.2 * max(map(len, runs.values()))
    size = (4.2 * width, (3.2 + legend) * height)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(height, width, squeeze=False)
    for axes in grid.flat[len(runs) :]:
        axes.remove()
    for axes, (task, lines) in zip(grid.flat, sorted(runs.items()), strict=False):
        draw_panel(axes, lines, metric)
        # `read_runs` gives offline runs panels of their own.
        kind = "gradient" if task.endswith(OFFLINE) else "environment"
        _label(axes, task, metric, f"{kind} steps")
    save(figure, path)


def draw_panel(axes: Axes, lines: Lines, metric: Metric) -> None:
    """Draw lines with a band over their seeds."""
    axes.set_prop_cycle(color=COLORS)
    for label, curves in sorted(lines.items()):
        # Unfinished runs are shorter, so draw only the steps that all seeds have.
        points = [{row["step"]: row[metric] for row in curve} for curve in curves]
        steps = sorted(set.intersection(*map(set, points)))
        values = np.array([[curve[step] for step in steps] for curve in points])
        low, median, high = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
        seeds = f"{len(curves)} seed{'s' if len(curves) > 1 else ''}"
        name = textwrap.fill(f"{label} ({seeds})", LABEL_WIDTH)
        # The dots show a line of one point.
        (line,) = axes.plot(steps, median, ".-", markersize=4, label=name)
        axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.2, lw=0)
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.2))


def read_runs(folders: list[Path], metric: Metric = "success") -> dict[str, Lines]:
    """Read a column of the curves of all runs below some folders, by task.

    Raises:
        ValueError: There is no run, or a run cannot be read or lacks the column.
    """
    runs: dict[str, Lines] = {}
    for path in sorted({p for folder in folders for p in folder.rglob("curve.csv")}):
        if not (path.parent / "args.json").exists():
            continue
        try:
            args = json.loads((path.parent / "args.json").read_text())
            task, algo = str(args["env_id"]), str(args["algo"]).upper()
            if args["preset"] == "offline":
                task += OFFLINE
            changed = args.get("changed", {})
            options = args.get("label") or line_label(str(args["preset"]), changed)
            with path.open() as file:
                curve = [
                    {key: float(row[key]) for key in ("step", metric)}
                    for row in csv.DictReader(file)
                ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"cannot read the run {path.parent}: {error!r}") from None
        if curve:
            runs.setdefault(task, {}).setdefault(f"{algo}, {options}", []).append(curve)
    if not runs:
        names = ", ".join(map(str, folders))
        raise ValueError(
            f"there is no run below {names}: a run is a folder with args.json and "
            "curve.csv"
        )
    return runs


def line_label(preset: str, changed: dict[str, object]) -> str:
    """Label of a set of options: its preset and the options that differ from it."""
    parts = [preset]
    for key, value in changed.items():
        name = key.replace("_", " ")
        if value is True or key == "demos":
            parts.append(name)
        elif value in (False, "none", 0):
            parts.append(f"no {name}")
        elif isinstance(value, dict):
            parts += [f"{option} {x:g}" for option, x in value.items()]
        elif isinstance(value, list):
            parts.append(f"{name} {' to '.join(f'{x:g}' for x in value)}")
        else:
            parts.append(f"{name} {value}")
    return ", ".join(parts)


def _label(axes: Axes, title: str, metric: Metric, xlabel: str) -> None:
    names = {"success": "success rate", "ever_success": "success rate at any step"}
    axes.set(xlabel=xlabel, ylabel=names.get(metric, metric), title=title)
    if metric in names:
        axes.set_ylim(-0.05, 1.05)
    axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 0))
    axes.grid(alpha=0.3)
