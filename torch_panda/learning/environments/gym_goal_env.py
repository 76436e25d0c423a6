"""Goal environments of Gymnasium, such as Fetch, as one batched environment."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box, Dict, Space
from gymnasium.vector import AutoresetMode, VectorEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_panda.checks import check_positive, check_seed

KEYS = ("observation", "achieved_goal", "desired_goal")
SUCCESS_KEYS = ("is_success", "success")  # in ``info``, the first one that is there
_ENDS = ("done", "terminated", "truncated")
# A goal that is this much larger in every number is not achieved.
_FAR = 1e3


class GymGoalEnv(EnvBase):
    """Environments of one Gymnasium id, stepped as one batch.

    The observation space must be a `Dict` of flat boxes under ``observation``,
    ``achieved_goal`` and ``desired_goal``. The action space must be a flat, bounded
    box, which is scaled to [-1, 1]. The environment must have a method
    ``compute_reward(achieved_goal, desired_goal, info)``, as in Gymnasium-Robotics. It
    is called with an empty ``info``, and with batches of goals if it takes them.

    All numbers are float32. Episodes are not reset by themselves, so the last
    observation of an episode is the true one. An environment that is stepped after its
    end begins its next episode first.

    A goal is reached if ``is_success`` or else ``success`` in ``info`` is true. Without
    both, and after a reset, it is reached if `compute_reward` gives the reward of an
    achieved goal. An episode that ends with success counts as truncated, because with
    another goal it would have gone on.

    Args:
        env_id: Id of the environment; the module that registers it must be imported.
        num_envs: Number of environments, n.
        seed: Seed of the first episodes; None draws one.
        workers: 1 steps all environments in this process. A larger number gives each
            environment a process of its own.
        device: Device of the outputs.
        renders: Whether `render` will be called.

    Attributes:
        env_id: The id.
        max_episode_steps: Number of steps after which an episode is truncated.
        has_sparse_reward: Whether `compute_reward` gives 0 for an achieved goal and -1
            for another one.
        terminate_on_success: False; see above.
        render_fps: Frames per second of a video in real time that has one frame per
            step.

    Raises:
        ValueError: The id is unknown, or the environment is not of this kind.
    """

    terminate_on_success = False

    def __init__(
        self,
        env_id: str,
        *,
        num_envs: int = 1,
        seed: int | None = None,
        workers: int = 1,
        device: torch.device | str | None = None,
        renders: bool = False,
    ) -> None:
        check_positive(num_envs=num_envs, workers=workers)
        self.env_id = env_id
        try:
            spec = gymnasium.spec(env_id)
            self._single = gymnasium.make(env_id)
        except gymnasium.error.Error as error:
            raise ValueError(f"Gymnasium cannot make {env_id!r}: {error}") from None
        problems = find_problems(self._single)
        if spec.max_episode_steps is None:
            problems.append("its registration has no max_episode_steps")
        if problems:
            self._single.close()
            raise ValueError(f"{env_id} cannot be used: {'; '.join(problems)}")
        self.max_episode_steps = int(spec.max_episode_steps or 0)
        self.render_fps = self._single.metadata.get("render_fps", 25)
        # Not every environment takes this argument.
        rendering: dict[str, Any] = {"render_mode": "rgb_array"} if renders else {}
        self._vector: VectorEnv[Any, Any, Any] = gymnasium.make_vec(
            env_id,
            num_envs=num_envs,
            vectorization_mode="sync" if workers == 1 else "async",
            vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
            **rendering,
        )
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.is_closed = False
        self._declare_specs()
        self._has_ended = np.zeros(num_envs, dtype=bool)
        self._seeds: list[int | None] = [None] * num_envs
        if seed is not None:
            self.set_seed(seed)
        self._takes_batches, reached, missed = self._probe_rewards()
        self._reached_reward = reached
        self.has_sparse_reward = (reached, missed) == (0.0, -1.0)
        self._rewards_show_success = reached > missed and missed in (0.0, -1.0)

    def _declare_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        space = self._vector.single_observation_space
        assert isinstance(space, Dict)

        def numbers(size: int) -> Unbounded:
            return Unbounded(torch.Size((n, size)), dtype=torch.float32, device=device)

        def flag() -> Binary:
            return Binary(shape=torch.Size((n, 1)), dtype=torch.bool, device=device)

        observed = {key: numbers(space[key].shape[0]) for key in KEYS}  # type: ignore[index]
        self.observation_spec = Composite(
            {**observed, "success": flag()}, shape=(n,), device=device
        )
        action = self._vector.single_action_space
        assert isinstance(action, Box)
        self._low, self._high = action.low, action.high
        self.action_spec = Bounded(
            -1.0,
            1.0,
            torch.Size((n, action.shape[0])),
            dtype=torch.float32,
            device=device,
        )
        self.reward_spec = numbers(1)
        ends = {key: flag() for key in _ENDS}
        self.done_spec = Composite(ends, shape=(n,), device=device)  # type: ignore[misc]

    def _probe_rewards(self) -> tuple[bool, float, float]:
        """Look at the rewards of an achieved goal and of a goal that is far away.

        Returns:
            Whether `compute_reward` takes batches of goals, and the two rewards.
        """
        observation, _ = self._single.reset(seed=0)
        goal = np.asarray(observation["achieved_goal"], dtype=float)
        achieved, desired = np.stack((goal, goal)), np.stack((goal, goal + _FAR))
        rewards = self._compute_singly(achieved, desired)
        try:
            batch = self._compute_batch(achieved, desired)
        except Exception:  # whatever its arithmetic raises for arrays
            takes_batches = False
        else:
            takes_batches = batch.size == 2 and np.allclose(batch.ravel(), rewards)
        return takes_batches, float(rewards[0]), float(rewards[1])

    # ---- goals -------------------------------------------------------------------

    def compute_reward(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Rewards of goals, as the environment's ``compute_reward`` gives them.

        Args:
            achieved_goal: Achieved goals, (..., goal size).
            desired_goal: Desired goals, (..., goal size).

        Returns:
            (..., 1) float32, on the device of the goals.
        """
        shape = achieved_goal.shape[:-1]
        achieved, desired = (
            goal.detach().cpu().double().reshape(-1, goal.shape[-1]).numpy()
            for goal in (achieved_goal, desired_goal)
        )
        compute = self._compute_batch if self._takes_batches else self._compute_singly
        rewards = torch.from_numpy(compute(achieved, desired))
        return rewards.reshape(*shape, 1).to(achieved_goal.device)

    def _compute_batch(
        self, achieved: npt.NDArray[Any], desired: npt.NDArray[Any]
    ) -> npt.NDArray[np.float32]:
        compute = self._single.unwrapped.compute_reward  # type: ignore[attr-defined]
        return np.asarray(compute(achieved, desired, {}), dtype=np.float32)

    def _compute_singly(
        self, achieved: npt.NDArray[Any], desired: npt.NDArray[Any]
    ) -> npt.NDArray[np.float32]:
        pairs = zip(achieved, desired, strict=True)
        rewards = [self._compute_batch(*pair).item() for pair in pairs]
        return np.array(rewards, dtype=np.float32)

    def is_success(self, achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
        """Whether goals are reached, by their reward: (..., 1) bool.

        All are False if the rewards do not show it, because they are dense.
        """
        rewards = self.compute_reward(achieved_goal, desired_goal)
        if not self._rewards_show_success:
            return torch.zeros_like(rewards, dtype=torch.bool)
        return rewards == self._reached_reward

    # ---- called by torchrl ---------------------------------------------------------

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        **options: Any,  # noqa: ANN401 (options of torchrl's reset, which are not used)
    ) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = np.ones(self.batch_size[0], dtype=bool)
        if mask is not None:
            chosen = mask.cpu().numpy().reshape(-1)
        observed = self._start(chosen)
        observed["success"] = self.is_success(*(observed[key] for key in KEYS[1:]))
        ends = {key: torch.zeros_like(observed["success"]) for key in _ENDS}
        return self._emit(observed | ends)

    def _start(self, chosen: npt.NDArray[np.bool_]) -> dict[str, Tensor]:
        """Start episodes of the chosen environments; observe all environments."""
        seeds = [s if k else None for s, k in zip(self._seeds, chosen, strict=True)]
        options = None if chosen.all() else {"reset_mask": chosen}
        # It takes a list of seeds too.
        observation, _ = self._vector.reset(
            seed=seeds,  # type: ignore[arg-type]
            options=options,
        )
        self._seeds = [
            None if k else s for s, k in zip(self._seeds, chosen, strict=True)
        ]
        self._has_ended[chosen] = False
        return _convert(observation)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if self._has_ended.any():
            self._start(self._has_ended.copy())
        action = tensordict["action"].detach().clamp(-1, 1).cpu().double().numpy()
        # This sum is exact at -1 and 1, so no rounding leads out of the bounds.
        scaled = (1 - action) / 2 * self._low + (1 + action) / 2 * self._high
        observation, reward, terminated, truncated, info = self._vector.step(
            scaled.astype(self._low.dtype)
        )
        self._has_ended = terminated | truncated
        observed = _convert(observation)
        success = self.is_success(*(observed[key] for key in KEYS[1:]))
        for key in reversed(SUCCESS_KEYS):
            if key in info:
                told = torch.as_tensor(np.asarray(info[key], dtype=bool)).unsqueeze(-1)
                is_told = torch.as_tensor(info[f"_{key}"]).unsqueeze(-1)
                success = torch.where(is_told, told, success)
        is_end = _column(self._has_ended)
        fails = _column(terminated) & ~success
        observed |= {
            "success": success,
            "reward": _column(reward).float(),
            "terminated": fails,
            "truncated": is_end & ~fails,
            "done": is_end,
        }
        return self._emit(observed)

    def set_env_seed(self, env: int, seed: int) -> None:
        """Seed the next episode of one environment."""
        self._seeds[env] = check_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        sequence = np.random.SeedSequence(seed)
        self._seeds = [int(x) for x in sequence.generate_state(self.batch_size[0])]

    def _emit(self, values: dict[str, Tensor]) -> TensorDict:
        return TensorDict(values, self.batch_size, self.device)

    # ---- pictures and closing --------------------------------------------------------

    def render(self, *, size: tuple[int, int]) -> Tensor:
        """Render the environments: uint8, (n, height, width, 3).

        Args:
            size: Height and width [pixels].

        Raises:
            OSError: The environment cannot be rendered.
        """
        from PIL import Image  # of the extra "learning"

        try:
            frames = self._vector.render()
        except Exception as error:  # each simulator has errors of its own
            raise OSError(
                f"{self.env_id} cannot be rendered ({error}); on a machine without a "
                "display, MuJoCo needs MUJOCO_GL=egl"
            ) from None
        assert frames is not None
        pictures = [Image.fromarray(np.asarray(frame)) for frame in frames]
        scaled = [np.asarray(picture.resize(size[::-1])) for picture in pictures]
        return torch.from_numpy(np.stack(scaled))

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments and their processes. Closing again does nothing."""
        if not self.is_closed:
            self._vector.close()
            self._single.close()
        self.is_closed = True

    def __enter__(self) -> "GymGoalEnv":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def find_problems(env: gymnasium.Env[Any, Any]) -> list[str]:
    """The reasons for which `GymGoalEnv` refuses an environment of Gymnasium."""
    problems = []
    space = env.observation_space
    entries: Sequence[Space[Any]] = []
    if isinstance(space, Dict) and not set(KEYS) - set(space.spaces):
        entries = [space[key] for key in KEYS]
    is_flat = [isinstance(x, Box) and len(x.shape) == 1 for x in entries]
    if not entries or not all(is_flat):
        problems.append(
            f"its observations must be a Dict of flat boxes named {', '.join(KEYS)}, "
            f"got {space}"
        )
    elif entries[1].shape != entries[2].shape:
        problems.append("achieved_goal and desired_goal differ in size")
    action = env.action_space
    is_box = isinstance(action, Box) and len(action.shape) == 1
    if not is_box or not action.is_bounded():  # type: ignore[attr-defined]
        problems.append(f"its actions must be a flat, bounded box, got {action}")
    if not callable(getattr(env.unwrapped, "compute_reward", None)):
        problems.append("it has no method compute_reward")
    return problems


def _convert(observation: dict[str, npt.NDArray[Any]]) -> dict[str, Tensor]:
    """Observations of all environments as float32, in new tensors."""
    return {key: torch.tensor(observation[key], dtype=torch.float32) for key in KEYS}


def _column(values: npt.NDArray[Any]) -> Tensor:
    """A number of each environment, (n, 1)."""
    return torch.tensor(values).unsqueeze(-1)
