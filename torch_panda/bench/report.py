"""The results as a table, and as JSON."""

import json
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from torch_panda.bench.comparison import Absence, Result
from torch_panda.bench.contenders import CONTENDERS
from torch_panda.info import num_cores, versions

_COLUMNS = (
    "environment",
    "envs",
    "threads",
    "contender",
    "steps/s",
    "torch_panda over it",
    "steps/CPU s",
    "torch_panda over it",
    "creation [ms]",
    "memory [MB]",
    "reset [ms]",
)


def table(results: Sequence[Result]) -> str:
    """A Markdown table, a row for each result.

    Speeds are medians and ranges over the rounds; costs are of one environment.
    """
    rows = [_COLUMNS, *(_row(result) for result in results)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(_COLUMNS))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True))
        for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths))
    return "\n".join(line + ("|" if line.endswith("-") else " |") for line in lines)


def notes(absences: Sequence[Absence]) -> str:
    """What was not measured and why, a line for each contender and reason."""
    lines = {
        f"not measured: {CONTENDERS[absence.contender].title}: {absence.reason}"
        for absence in absences
    }
    return "\n".join(sorted(lines))


def write_json(
    path: Path, results: Sequence[Result], absences: Sequence[Absence]
) -> None:
    """Write all figures, those of each round, and on what they were measured."""
    document = {
        "machine": {"platform": platform.platform(), "cores": num_cores()},
        "versions": versions(),
        "results": [_figures(result) for result in results],
        "not_measured": [asdict(absence) for absence in absences],
    }
    path.write_text(json.dumps(document, indent=2) + "\n")


def _row(result: Result) -> tuple[str, ...]:
    setting, footprint = result.setting, result.footprint
    memory = "-" if footprint.memory is None else f"{footprint.memory:.0f}"
    return (
        setting.env_id,
        str(setting.num_envs),
        str(setting.num_threads),
        CONTENDERS[result.contender].title,
        _spread([speed.per_second for speed in result.speeds], digits=0),
        _spread([ratio.per_second for ratio in result.ratios], digits=2),
        _spread([speed.per_cpu_second for speed in result.speeds], digits=0),
        _spread([ratio.per_cpu_second for ratio in result.ratios], digits=2),
        f"{1e3 * footprint.creation:.0f}",
        memory,
        f"{1e3 * footprint.reset:.2f}",
    )


def _spread(values: Sequence[float], *, digits: int) -> str:
    """Median and range."""
    middle, low, high = (
        f"{value:.{digits}f}" for value in (median(values), min(values), max(values))
    )
    return f"{middle} ({low} to {high})"


def _figures(result: Result) -> dict[str, Any]:
    return {
        **asdict(result),
        "speeds": [speed._asdict() for speed in result.speeds],
        "ratios": [ratio._asdict() for ratio in result.ratios],
    }
