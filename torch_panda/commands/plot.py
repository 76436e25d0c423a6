"""Draw the success curves of runs: medians and quartiles over seeds.

python -m torch_panda plot runs --out curves.png
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from torch_panda.learning.plots import Metric, plot_panels, read_runs


@dataclass
class Args:
    """Draw the success curves of runs."""

    runs: Annotated[list[Path], tyro.conf.Positional]
    """folders with runs, at any depth"""
    metric: Metric = "success"
    """column of the curves to draw"""
    out: Path = Path("curves.png")
    """picture to write"""


def main(args: Args) -> None:
    """Draw the runs."""
    out = args.out.with_suffix(args.out.suffix or ".png")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        plot_panels(read_runs(args.runs, args.metric), args.metric, out)
    except (ValueError, OSError) as error:
        raise SystemExit(f"cannot draw: {error}") from None
    print(f"wrote {out}")


def run(arguments: Sequence[str]) -> None:
    """Read the options and run the command."""
    main(tyro.cli(Args, prog="python -m torch_panda plot", args=arguments))
