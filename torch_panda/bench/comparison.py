"""The measurement: contenders take turns, so that a noisy machine is noisy for all."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from torch_panda.bench.contenders import CONTENDERS, OURS
from torch_panda.bench.processes import available_memory
from torch_panda.bench.runner import ContenderError, Footprint, Runner
from torch_panda.bench.stepping import Setting, Speed

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
        footprint: what the environments cost.
    """

    setting: Setting
    contender: str
    speeds: tuple[Speed, ...]
    ratios: tuple[Speed, ...]
    footprint: Footprint


@dataclass(frozen=True)
class Absence:
    """A contender that was not measured in a setting, and why."""

    setting: Setting
    contender: str
    reason: str


def work_of(settings: int, contenders: int, rounds: int) -> int:
    """How often `compare` calls its ``progress`` at most."""
    return settings * contenders * (1 + rounds)


def compare(
    setting: Setting,
    contenders: Sequence[str],
    *,
    rounds: int,
    steps: int,
    progress: Progress,
) -> tuple[list[Result], list[Absence]]:
    """Measure contenders in turns: A B C, A B C, and so on.

    Each warms up by a round that is not counted. Where the memory is enough for each of
    them, but not for all at once, they are made anew for every round.

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
    # A system without memory ends any process.
    memory = 0.9 * available_memory()
    fitting: list[str] = []
    for name in [OURS, *(name for name in contenders if name != OURS)]:
        reason = CONTENDERS[name].why_not(setting, memory)
        if reason is None:
            fitting.append(name)
        elif name == OURS:
            raise ContenderError(reason)
        else:
            absences.append(Absence(setting, name, reason))
    needed = sum(CONTENDERS[name].memory for name in fitting) * setting.num_envs
    footprints: dict[str, Footprint] = {}
    with ExitStack() as stack:
        living: dict[str, Runner] = {}
        for name in fitting:
            progress(f"start {name}")
            try:
                runner = stack.enter_context(Runner(name, setting))
            except ContenderError as error:
                if name == OURS:
                    raise
                absences.append(Absence(setting, name, str(error)))
                continue
            footprints[name] = runner.footprint
            if needed <= memory:
                runner.measure(steps)  # warms up
                living[name] = runner
            else:
                runner.close()
        speeds: dict[str, list[Speed]] = {name: [] for name in footprints}
        for _ in range(rounds):
            for name in footprints:
                progress(f"{setting.env_id} x {setting.num_envs}: {name}")
                speeds[name].append(
                    living[name].measure(steps)
                    if name in living
                    else _measure_alone(name, setting, steps)
                )
    ours = speeds[OURS]
    results = [
        Result(
            setting=setting,
            contender=name,
            speeds=tuple(speeds[name]),
            ratios=tuple(
                Speed(a.per_second / b.per_second, a.per_cpu_second / b.per_cpu_second)
                for a, b in zip(ours, speeds[name], strict=True)
            ),
            footprint=footprints[name],
        )
        for name in footprints
    ]
    return results, absences


def _measure_alone(name: str, setting: Setting, steps: int) -> Speed:
    with Runner(name, setting) as runner:
        runner.measure(steps)  # warms up
        return runner.measure(steps)
