"""Generates data sets for offline learning from an id, a kind and a seed.

The same arguments give the same data, for any number of environments and threads.
Compare data sets by their `sha256`.
"""

import hashlib
import math
from collections.abc import Callable, Iterator
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_panda import RobotTaskEnv
from torch_panda.checks import check_not_negative, check_positive, check_seed
from torch_panda.experts import make_expert
from torch_panda.learning.environments import (
    GoalEnv,
    episode_length,
    is_from_gymnasium,
    make_env,
)
from torch_panda.tasks import Task

Kind = Literal["noisy", "play", "random"]

PLAY_STEPS = 1000  # length of an episode of "play"
HOLD_STEPS = 10  # steps for which "play" stays at a goal after reaching it
MAX_NOISE = 0.5  # largest standard deviation of the noise of "noisy"
# Noise of "play" as in OGBench's play data (arXiv 2410.20092): its scale, and the
# weights of the filter that smooths it, as multiples of the largest one. The filter is
# Gaussian with a standard deviation of half a step, cut off after four of them.
PLAY_NOISE = 0.1
SMOOTHING = [math.exp(-2 * k**2) for k in range(-2, 3)]


def generate(
    env_id: str,
    *,
    kind: Kind,
    transitions: int,
    seed: int,
    num_envs: int,
    num_threads: int | None = None,
    play_noise: float = PLAY_NOISE,
    progress: Callable[[int], object] | None = None,
    **make_options: Any,  # noqa: ANN401 (options of `torch_panda.make`)
) -> TensorDict:
    """Generate a data set of whole episodes.

    All episodes have the same length: neither success nor failure ends them, so
    ``terminated`` is always false. Episode e depends on (``seed``, e) alone, so
    ``num_envs`` and ``num_threads`` change only the running time.

    Args:
        env_id: Id of the task.
        kind: How actions are chosen. "noisy": by the scripted expert, with Gaussian
            noise whose standard deviation is drawn per episode from 0 to `MAX_NOISE`.
            "play": by the expert with smooth noise. It pursues one goal after another
            without reset, for `PLAY_STEPS` steps. It gets the next goal when it has
            stayed at a goal for `HOLD_STEPS` steps, or when it has pursued the goal for
            `Task.max_episode_steps` steps. "random": uniformly.
        transitions: Number of transitions, rounded up to whole episodes.
        seed: Seed of the data set.
        num_envs: Number of environments stepped in parallel.
        num_threads: Number of threads that step them; None means one per core
            that the process may use.
        play_noise: Scale of the noise on the actions of "play": Gaussian noise of this
            standard deviation, smoothed over time by a Gaussian filter whose standard
            deviation is half a step. The data contain the executed, noisy actions.
        progress: Called with the number of new transitions after every step.
        **make_options: Further arguments of `torch_panda.make`.

    Returns:
        Transitions [episodes, steps] with ``observation``, ``achieved_goal``,
        ``desired_goal``, ``action`` and ``("collector", "traj_ids")``. Under ``next``
        are the observation and goals after the action, ``reward``, ``success``,
        ``terminated``, ``truncated`` and ``done``. In "play", both entries
        ``desired_goal`` are the goal that the expert pursues in the step.

    Raises:
        ValueError: The kind is unknown, there is no expert for the id, a number is out
            of range, an option of `make` contradicts the kind, or the kind is "play"
            and the goals of the task depend on the start of an episode.
    """
    parts = generate_parts(
        env_id,
        kind=kind,
        transitions=transitions,
        seed=seed,
        num_envs=num_envs,
        num_threads=num_threads,
        play_noise=play_noise,
        progress=progress,
        **make_options,
    )
    return TensorDict.cat(list(parts))


def generate_parts(
    env_id: str,
    *,
    kind: Kind,
    transitions: int,
    seed: int,
    num_envs: int,
    num_threads: int | None,
    play_noise: float,
    progress: Callable[[int], object] | None,
    **make_options: Any,  # noqa: ANN401 (options of `torch_panda.make`)
) -> Iterator[TensorDict]:
    """Generate the data set of `generate` in parts of at most ``num_envs`` episodes.

    The arguments are those of `generate`.

    Yields:
        Transitions [episodes, steps].

    Raises:
        ValueError: As for `generate`.
    """
    if kind not in get_args(Kind):
        names = ", ".join(get_args(Kind))
        raise ValueError(f"kind must be one of {names}, got {kind!r}")
    check_positive(transitions=transitions, num_envs=num_envs)
    check_not_negative(play_noise=play_noise)
    if play_noise != PLAY_NOISE and kind != "play":
        raise ValueError(
            f'play_noise works with the kind play only, got {play_noise} and "{kind}"'
        )
    if make_options.get("device") not in (None, "cpu", torch.device("cpu")):
        raise ValueError(
            f"data are generated on the CPU, got device={make_options['device']!r}: "
            "leave it out, and move the data"
        )
    seed = check_seed(seed)
    for name, fixed in fixed_options(kind).items():
        if make_options.get(name) not in (None, fixed):
            raise ValueError(
                f"{name} must be {fixed} in data of the kind {kind}, got "
                f"{make_options[name]!r}"
            )
    if kind != "random" and make_options.get("goal", "task") != "task":
        raise ValueError(
            f"the experts of the kind {kind} need the goals of the task: leave out "
            f"goal={make_options['goal']!r}, or use the kind random"
        )
    make_options = {**make_options, **fixed_options(kind)}
    num_episodes, steps = batch_shape(env_id, kind, transitions, **make_options)
    num_envs = min(num_envs, num_episodes)
    if is_from_gymnasium(env_id):
        make_options.pop("terminate_on_success")
    with make_env(
        env_id, num_envs=num_envs, num_threads=num_threads, **make_options
    ) as env:
        expert = None
        if kind != "random":
            expert = make_expert(env if isinstance(env, RobotTaskEnv) else env_id)
        draws_with_start = (
            isinstance(env, RobotTaskEnv)
            and type(env.task).sample_start is not Task.sample_start
        )
        if kind == "play" and draws_with_start:
            raise ValueError(
                'kind "play" needs goals that do not depend on the start of an '
                f'episode, but those of {env_id} do: use "noisy" or "random"'
            )
        for start in range(0, num_episodes, num_envs):
            # In the last batch, environments may be left over: drop their episodes.
            episode_ids = torch.arange(start, min(start + num_envs, num_episodes))
            batch = _Batch(env, expert, kind, seed, start, play_noise)
            rows = []
            for _ in range(steps):
                rows.append(batch.step())
                if progress is not None:
                    progress(len(episode_ids))
            part = TensorDict.stack(rows, 1)[: len(episode_ids)]
            part["collector", "traj_ids"] = episode_ids[:, None].repeat(1, steps)
            yield part


def fixed_options(kind: str) -> dict[str, Any]:
    """The arguments of `torch_panda.make` that a kind fixes."""
    options: dict[str, Any] = {"terminate_on_success": False}
    if kind == "play":
        options["max_episode_steps"] = PLAY_STEPS
    return options


def batch_shape(
    env_id: str,
    kind: Kind,
    transitions: int,
    **make_options: Any,  # noqa: ANN401 (options of `torch_panda.make`)
) -> tuple[int, int]:
    """Batch shape [episodes, steps] of the data set that `generate` returns."""
    options = {**make_options, **fixed_options(kind)}
    steps = options.get("max_episode_steps") or episode_length(env_id)
    return -(-transitions // steps), steps


def episode_seed(seed: int, number: int) -> int:
    """Seed of the environment for an episode of a data set.

    To start this episode again, call ``env.set_env_seed(index, episode_seed(seed,
    number))`` and then reset.
    """
    return _spawn(seed, number)[0]


def _spawn(seed: int, number: int) -> tuple[int, np.random.Generator]:
    """Seed of an episode's environment, and generator of its other random draws."""
    env_seed, other_seed = np.random.SeedSequence((seed, number)).spawn(2)
    # Data sets store the seed as an int64, so drop one of the 64 bits.
    value = int(env_seed.generate_state(1, np.uint64)[0] >> 1)
    return value, np.random.default_rng(other_seed)


class _Batch:
    """One episode in each environment: environment i plays episode ``first`` + i."""

    def __init__(
        self,
        env: GoalEnv,
        expert: TensorDictModuleBase | None,
        kind: Kind,
        seed: int,
        first: int,
        play_noise: float,
    ) -> None:
        self._env, self._expert, self._kind = env, expert, kind
        self._generators = []
        noise = []
        for index in range(env.batch_size[0]):
            env_seed, generator = _spawn(seed, first + index)
            env.set_env_seed(index, env_seed)
            self._generators.append(generator)
            # Draw it for all kinds, because the published hashes depend on this draw.
            noise.append(generator.uniform(0.0, MAX_NOISE))
        self._noise = torch.tensor(noise, dtype=torch.float32).unsqueeze(1)
        outcome = {"success"}
        if isinstance(env, RobotTaskEnv):
            outcome |= env.episodes.info_keys
        self._keys = [key for key in env.observation_spec if key not in outcome]
        self._observations = env.reset()
        self._has_ended = False
        if kind == "play":
            self._goal = self._observations["desired_goal"].clone()
            self._steps_at_goal = torch.zeros(env.batch_size[0], dtype=torch.int64)
            self._steps_since_goal = torch.zeros_like(self._steps_at_goal)
            assert isinstance(env, RobotTaskEnv)  # the others have no expert
            self._task = env.task
            self._max_steps_per_goal = type(env.task).max_episode_steps
            self._play_noise = play_noise
            self._draws: list[Tensor] = []  # noise of the last steps, newest last

    @torch.no_grad()
    def step(self) -> TensorDictBase:
        """Act for one step.

        Returns:
            The transitions of all environments, (num_envs,).

        Raises:
            ValueError: An episode has ended in an earlier step.
        """
        env = self._env
        if self._has_ended:
            raise ValueError(
                f"{env.env_id} ends episodes before their time limit, and data sets "
                "hold whole episodes only"
            )
        row = self._observations.select(*self._keys)
        if self._kind == "play":
            row["desired_goal"] = self._goal.clone()
        row["action"] = self._act(row)
        row = env.step(row)
        after: TensorDictBase = row["next"]  # type: ignore[assignment]
        self._observations = after.select(*self._keys)
        # `Task.failure` terminates, but the episode goes on until its last step. Those
        # of Gymnasium end.
        if not isinstance(env, RobotTaskEnv):
            self._has_ended = bool(after["done"].any())
        after["terminated"] = torch.zeros_like(after["terminated"])
        after["done"] = after["truncated"].clone()
        if self._kind == "play":
            self._apply_pursued_goals(row)
            self._change_goals(row)
        return row

    def _act(self, row: TensorDictBase) -> Tensor:
        shape = self._env.action_spec.shape[1:]
        if self._expert is None:
            return self._draw(lambda rng: rng.uniform(-1.0, 1.0, shape))
        action = self._expert(row.copy())["action"]
        if self._kind == "noisy":
            noise = self._draw(lambda rng: rng.normal(0.0, 1.0, shape))
            action = (action + self._noise * noise).clamp(-1.0, 1.0)
        if self._kind == "play" and self._play_noise:
            noise = self._play_noise * self._draw_smooth_noise(shape)
            action = (action + noise).clamp(-1.0, 1.0)
        return action

    def _draw_smooth_noise(self, shape: torch.Size) -> Tensor:
        """Draw standard normal noise, smoothed over the last steps."""
        while len(self._draws) < len(SMOOTHING):
            self._draws.append(self._draw(lambda rng: rng.normal(0.0, 1.0, shape)))
        # Add tensor by tensor: `Tensor.sum` rounds differently for other `num_envs`.
        smooth = torch.zeros_like(self._draws[0])
        for weight, draw in zip(SMOOTHING, self._draws, strict=True):
            smooth += weight * draw
        del self._draws[0]
        return smooth / sum(SMOOTHING)

    def _apply_pursued_goals(self, row: TensorDictBase) -> None:
        """Replace goal, reward and success of a step by those of the pursued goals."""
        after: TensorDictBase = row["next"]  # type: ignore[assignment]
        after["desired_goal"] = row["desired_goal"].clone()
        goals = after["achieved_goal"], after["desired_goal"]
        after["reward"] = self._env.compute_reward(*goals)
        after["success"] = self._env.is_success(*goals)

    def _change_goals(self, row: TensorDictBase) -> None:
        """Draw a new goal where the expert stayed at its goal or ran out of steps."""
        success = row["next", "success"].squeeze(-1)
        self._steps_at_goal = torch.where(success, self._steps_at_goal + 1, 0)
        self._steps_since_goal += 1
        changes = self._steps_at_goal >= HOLD_STEPS
        changes |= self._steps_since_goal >= self._max_steps_per_goal
        for index in changes.nonzero().flatten().tolist():
            goal = self._task.sample_start(self._generators[index]).goal
            self._goal[index] = torch.as_tensor(goal, dtype=self._goal.dtype)
        self._steps_at_goal[changes] = 0
        self._steps_since_goal[changes] = 0

    def _draw(self, sample: Callable[[np.random.Generator], Any]) -> Tensor:
        """Sample with the generator of each episode, (num_envs, ...) float32."""
        values = np.stack([sample(generator) for generator in self._generators])
        return torch.from_numpy(values).float()


def sha256(data: TensorDictBase) -> str:
    """Compute a hash of the keys, shapes, types and numbers of a data set.

    Returns:
        64 hexadecimal digits. They do not depend on the order of the keys.
    """
    digest = hashlib.sha256()
    leaves: dict[str, Tensor] = {
        ".".join(key if isinstance(key, tuple) else (key,)): value
        for key, value in data.items(include_nested=True, leaves_only=True)
    }
    for name in sorted(leaves):
        values = leaves[name].cpu().contiguous().numpy()
        little_endian = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {little_endian.dtype.str} {values.shape}\n".encode())
        digest.update(little_endian.tobytes())
    return digest.hexdigest()
