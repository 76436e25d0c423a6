"""The results as a picture: a bar for each contender, a panel for each setting."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from statistics import median

from torch_panda.bench.comparison import Result
from torch_panda.bench.contenders import CONTENDERS


def plot(path: Path, results: Sequence[Result]) -> None:
    """Draw steps per second, medians and ranges over the rounds.

    Args:
        path: where to write, in a format that its suffix names.
        results: in the order in which they are drawn.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    panels = [
        (setting, list(group))
        for setting, group in groupby(results, key=lambda result: result.setting)
    ]
    num_bars = sum(len(group) for _, group in panels)
    figure, axes = plt.subplots(
        len(panels),
        squeeze=False,
        sharex=True,
        figsize=(7, 0.8 * len(panels) + 0.3 * num_bars),
        height_ratios=[len(group) for _, group in panels],
        layout="constrained",
    )
    for axis, (setting, group) in zip(axes[:, 0], panels, strict=True):
        speeds = [[s.per_second for s in result.speeds] for result in group]
        middle = [median(speed) for speed in speeds]
        below = [m - min(speed) for m, speed in zip(middle, speeds, strict=True)]
        above = [max(speed) - m for m, speed in zip(middle, speeds, strict=True)]
        titles = [CONTENDERS[result.contender].title for result in group]
        bars = axis.barh(titles, middle, xerr=(below, above), color="tab:gray")
        bars[0].set_color("tab:blue")  # ours
        axis.bar_label(bars, fmt="%.0f", label_type="center", color="white")
        axis.invert_yaxis()
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_title(
            f"{setting.env_id}: {setting.num_envs} environments, "
            f"{setting.num_threads} threads",
            fontsize="medium",
            loc="left",
        )
    axes[-1, 0].set_xlabel("steps/s")
    figure.savefig(path, dpi=150)
    plt.close(figure)
