"""Plots of success curves: one panel per task, and one line per set of options.

A run is a folder with args.json and curve.csv. A line is the median over the seeds, and
a band shows the interquartile range, as in the panda-gym paper. A panel has at most
four lines. A task with more lines has a panel for each algorithm. Colour and dashes of
a line show the options, and its marker shows the algorithm, the same in all panels.

The legend names the algorithm and the options that differ from the preset. An entry
``label`` in args.json replaces the options by a name. Runs of one task and algorithm
that have the same name form one line.
"""

import csv
import itertools
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
MAX_LINES = 4  # largest number of lines in a panel
COLUMNS = 3  # largest number of panels side by side
OFFLINE = ", offline"  # suffix of a title if the steps of the panel are gradient steps
LABEL_WIDTH = 56  # characters after which a label is wrapped
# Okabe and Ito's colours, which colour-blind readers can tell apart.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
DASHES = ("-", "--", ":", "-.")
# Markers of the algorithms in alphabetical order. The first algorithm has none.
MARKERS = ("", "s", "^", "D", "v", "P", "X", "*")

Line = tuple[str, str]
"""Algorithm and label of the options."""
Lines = dict[Line, list[Curve]]
"""The curves of all seeds, by line."""


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
    """Draw median and interquartile range over seeds.

    Args:
        runs: Lines of each task.
        metric: Column of the curves to draw.
        path: Picture to write.

    Raises:
        OSError: The picture cannot be written.
        ValueError: The ending of its name is not a format.
    """
    panels = [panel for task in sorted(runs) for panel in split(task, runs[task])]
    lines = [line for _, panel in panels for line in panel]
    # The first 28 sets of options differ in dashes or colour.
    looks = itertools.cycle(itertools.product(DASHES, COLORS))
    ways = dict(zip(dict.fromkeys(way for _, way in lines), looks, strict=False))
    names = sorted({algo for algo, _ in lines})
    markers = dict(zip(names, itertools.cycle(MARKERS), strict=False))
    width = min(COLUMNS, len(panels))
    height = -(-len(panels) // width)
    # Legends are below the panels.
    figure = Figure(figsize=(4.2 * width, 4.0 * height), layout="constrained")
    grid = figure.subplots(height, width, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    for axes, (title, panel) in zip(grid.flat, panels, strict=False):
        draw_panel(axes, panel, metric, ways, markers)
        # `read_runs` gives offline runs panels of their own.
        kind = "gradient" if OFFLINE in title else "environment"
        _label(axes, title, metric, f"{kind} steps")
    save(figure, path)


def split(task: str, lines: Lines) -> list[tuple[str, Lines]]:
    """Distribute the lines of a task over panels.

    All algorithms share a panel if it has at most `MAX_LINES` lines. Otherwise each
    algorithm has its own panels.

    Returns:
        Title and lines of each panel.
    """
    ordered = sorted(lines.items())
    if len(ordered) <= MAX_LINES:
        return [(task, dict(ordered))]
    panels = []
    for algo, group in itertools.groupby(ordered, lambda item: item[0][0]):
        of_algo = list(group)
        for first in range(0, len(of_algo), MAX_LINES):
            panels.append((f"{task}, {algo}", dict(of_algo[first : first + MAX_LINES])))
    return panels


def draw_panel(
    axes: Axes,
    panel: Lines,
    metric: Metric,
    ways: dict[str, tuple[str, str]],
    markers: dict[str, str],
) -> None:
    """Draw lines with a band over their seeds.

    Args:
        axes: Where to draw.
        panel: Curves of each line.
        metric: Column of the curves to draw.
        ways: Dashes and colour of each way to train.
        markers: Marker of each algorithm.
    """
    for (algo, way), curves in panel.items():
        # Unfinished runs are shorter, so draw only the steps that all seeds have.
        points = [{row["step"]: row[metric] for row in curve} for curve in curves]
        steps = sorted(set.intersection(*map(set, points)))
        values = np.array([[curve[step] for step in steps] for curve in points])
        low, median, high = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
        seeds = f"{len(curves)} seed{'s' if len(curves) > 1 else ''}"
        label = textwrap.fill(f"{algo}, {way} ({seeds})", LABEL_WIDTH)
        dashes, color = ways[way]
        axes.plot(
            steps,
            median,
            dashes,
            color=color,
            # A line of one point needs a marker to be seen.
            marker=markers[algo] or ("o" if len(steps) == 1 else ""),
            markersize=4,
            markevery=0.1,  # at most one marker in a tenth of the panel's diagonal
            label=label,
        )
        axes.fill_between(steps, low, high, color=color, alpha=0.2, lw=0)
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.2))


def read_runs(folders: list[Path]) -> dict[str, Lines]:
    """Read the curves of all runs below some folders, by task.

    Raises:
        ValueError: There is no run, or a run cannot be read.
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
            label = str(args.get("label") or line_label(str(args["preset"]), changed))
            with path.open() as file:
                curve = [
                    {key: float(value) for key, value in row.items() if value}
                    for row in csv.DictReader(file)
                ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"cannot read the run {path.parent}: {error!r}") from None
        if curve:
            runs.setdefault(task, {}).setdefault((algo, label), []).append(curve)
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
