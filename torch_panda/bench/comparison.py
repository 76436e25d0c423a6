"""The measurement: contenders take turns, so that a noisy machine is noisy for all."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from torch_panda.bench.bare_bullet import Speed
from torch_panda.bench.contenders import CONTENDERS, OURS, Setting
from torch_panda.bench.processes import available_memory
from torch_panda.bench.runner import ContenderError, Footprint, Runner

# Called with what is being done, whenever a piece of the work begins.
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Result:
    """What one contender came to in one setting.

    Attributes:
        setting: what was measured.
        contender: its name, a key of `CONTENDERS`.
        speeds: steps of all environments together, a round each.
        ratios: torch_panda's speed over this one's, a round each.
        footprint: what the environments cost; None where it was not measured.
    """

    setting: Setting
    contender: str
    speeds: tuple[Speed, ...]
    ratios: tuple[Speed, ...]
    footprint: Footprint | None


@dataclass(frozen=True)
class Absence:
    """A contender that was not measured in a setting, and why."""

    setting: Setting
    contender: str
    reason: str


def work_of(settings: int, contenders: int, rounds: int) -> int:
    """How often `compare` calls its ``progress`` at most."""
    return settings * contenders * (1 + 1 + rounds)


def compare(
    setting: Setting,
    contenders: Sequence[str],
    *,
    rounds: int,
    steps: int,
    progress: Progress,
) -> tuple[list[Result], list[Absence]]:
    """Measure contenders in turns: A B C, A B C, and so on.

    The first round warms up and is not counted.

    Args:
        setting: what to measure.
        contenders: keys of `CONTENDERS`; torch_panda itself is always measured.
        rounds: how often each is measured.
        steps: steps of each environment in a round.
        progress: called at each piece of the work.

    Returns:
        what was measured, torch_panda first, and what was not.

    Raises:
        ContenderError: torch_panda itself failed or needs more memory than is free, or
            one failed while it ran.
    """
    absences: list[Absence] = []
    # All live at the same time, and a system without memory ends any process.
    memory = 0.9 * available_memory()
    with ExitStack() as stack:
        runners: dict[str, Runner] = {}
        for name in [OURS, *(name for name in contenders if name != OURS)]:
            progress(f"start {name}")
            entry = CONTENDERS[name]
            reason = entry.why_not(setting, memory)
            if reason is None:
                try:
                    runners[name] = stack.enter_context(Runner(name, setting))
                    memory -= entry.memory * setting.num_envs
                except ContenderError as error:
                    reason = str(error)
            if reason is not None:
                if name == OURS:
                    raise ContenderError(reason)
                absences.append(Absence(setting, name, reason))
        speeds: dict[str, list[Speed]] = {name: [] for name in runners}
        for _ in range(1 + rounds):
            for name, runner in runners.items():
                progress(f"{setting.env_id} x {setting.num_envs}: {name}")
                speeds[name].append(runner.measure(steps))
        footprints = {name: runner.footprint for name, runner in runners.items()}
    ours = speeds[OURS][1:]
    results = [
        Result(
            setting=setting,
            contender=name,
            speeds=tuple(speeds[name][1:]),
            ratios=tuple(
                Speed(a.per_second / b.per_second, a.per_cpu_second / b.per_cpu_second)
                for a, b in zip(ours, speeds[name][1:], strict=True)
            ),
            footprint=footprints[name],
        )
        for name in runners
    ]
    return results, absences
