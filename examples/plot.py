"""Draw success curves: a panel per task, a line per algorithm or ablation.

    python examples/plot.py runs --out curves.png

Reads every folder below the given ones that holds a run (args.json and curve.csv).
Draws the median and the interquartile range over the seeds, as the panda-gym paper.
"""

import csv
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import numpy as np
import tyro

Curve = list[dict[str, float]]
Metric = Literal["success", "ever_success", "return"]
COLUMNS = 3  # of panels


def plot_curve(curve: Curve, title: str, path: Path) -> None:
    """Draw one run's success over environment steps."""
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    axes.plot([row["step"] for row in curve], [row["success"] for row in curve], "o-")
    _label(axes, title, "success")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def plot_panels(
    runs: dict[str, dict[str, list[Curve]]], metric: Metric, path: Path
) -> None:
    """Draw median and interquartile range over seeds.

    Args:
        runs: by task, then by line, the curves of the seeds.
        metric: the column to draw.
        path: where to write the picture.
    """
    columns = min(len(runs), COLUMNS)
    rows = -(-len(runs) // columns)
    most = max(len(lines) for lines in runs.values())
    figure, panels = plt.subplots(
        rows,
        columns,
        figsize=(5 * columns, (3.5 + 0.2 * most) * rows),  # legends are below
        squeeze=False,
        layout="constrained",
    )
    for axes in panels.flat[len(runs) :]:
        axes.remove()
    labels = sorted({label for lines in runs.values() for label in lines})
    colors = dict(
        zip(labels, plt.cm.turbo(np.linspace(0, 0.95, len(labels))), strict=True)
    )
    for axes, (task, lines) in zip(panels.flat, sorted(runs.items()), strict=False):
        for label, curves in sorted(lines.items()):
            # Seeds that are still running end earlier: up to where all have come.
            length = min(len(curve) for curve in curves)
            steps = [row["step"] for row in curves[0][:length]]
            values = np.array([[r[metric] for r in c[:length]] for c in curves])
            low, median, high = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
            name = f"{label} ({len(curves)} seed{'s' if len(curves) > 1 else ''})"
            marker = "o" if length == 1 else None
            axes.plot(steps, median, marker=marker, color=colors[label], label=name)
            axes.fill_between(steps, low, high, color=colors[label], alpha=0.2, lw=0)
        _label(axes, task, metric)
        axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.2))
    figure.savefig(path, dpi=120)
    plt.close(figure)


def read_runs(folders: list[Path]) -> dict[str, dict[str, list[Curve]]]:
    """Read the curves below some folders: by task, then by line.

    Raises:
        ValueError: there is no run, or what one of them holds cannot be read.
    """
    runs: dict[str, dict[str, list[Curve]]] = defaultdict(lambda: defaultdict(list))
    for path in sorted({p for folder in folders for p in folder.rglob("curve.csv")}):
        try:
            args = json.loads((path.parent / "args.json").read_text())
            task, line = args["env_id"], line_label(args)
            with path.open() as file:
                curve = [
                    {key: float(value) for key, value in row.items()}
                    for row in csv.DictReader(file)
                ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path.parent} holds no run: {error!r}") from None
        if curve:
            runs[task][line].append(curve)
    if not runs:
        names = ", ".join(map(str, folders))
        raise ValueError(f"no run (args.json, curve.csv) below {names}")
    return runs


def line_label(args: dict[str, object]) -> str:
    """Name what sets a run apart from others of its task, but for the seed."""
    parts = [str(args["algo"]).upper()]
    if args["preset"] != "paper":
        parts.append(str(args["preset"]))
    parts.append(
        {"relabel": "HER", "augment": "HER (stored copies)"}.get(
            str(args["her"]), "no HER"
        )
    )
    if not args["double_q"]:
        parts.append("one Q")
    if args.get("demos"):
        parts.append("demonstrations")
    if args["updates_per_step"] != 0.5:  # the presets'
        parts.append(f"{args['updates_per_step']} updates a step")
    if args.get("start_at_object"):
        parts.append("starts at objects")
    if args.get("pretrain_updates"):
        parts.append("imitation first")
    if args["preset"] == "tuned":
        wanted = {"mirror": "mirror", "relative_inputs": "relative", "shift": "shift"}
        parts += [f"no {name}" for key, name in wanted.items() if not args.get(key)]
    if args.get("fine_inputs"):
        parts.append("fine inputs")
    return ", ".join(parts)


def _label(axes: plt.Axes, title: str, metric: Metric) -> None:
    names = {"success": "success rate", "ever_success": "success rate at any step"}
    axes.set(xlabel="environment steps", ylabel=names.get(metric, metric), title=title)
    if metric in names:
        axes.set_ylim(-0.05, 1.05)
    axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 0))
    axes.grid(alpha=0.3)


@dataclass
class Args:
    """Which runs to draw, and where."""

    runs: Annotated[list[Path], tyro.conf.Positional]
    """folders that hold runs, at any depth"""
    metric: Metric = "success"
    """column of the curves"""
    out: Path = Path("curves.png")
    """picture to write"""


def main(args: Args) -> None:
    """Draw the runs."""
    out = args.out if args.out.suffix else args.out.with_suffix(".png")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        plot_panels(read_runs(args.runs), args.metric, out)
    except (ValueError, OSError) as error:
        raise SystemExit(f"cannot draw: {error}") from None
    print(f"wrote {out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
