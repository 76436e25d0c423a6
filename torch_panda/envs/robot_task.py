"""A robot and a task, as one batched TorchRL environment."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import RandomPolicy

from torch_panda.bullet import PhysicsName, PhysicsParams
from torch_panda.closing import Closing
from torch_panda.envs.checks import check_device
from torch_panda.envs.episodes import Episodes, OnDivergence, indices
from torch_panda.envs.observer import Observed
from torch_panda.envs.persistence import PersistentEnv
from torch_panda.envs.pictures import PicturedEnv
from torch_panda.envs.specs import Specs
from torch_panda.envs.state import EXACT_KEYS, means_state
from torch_panda.randomization import Randomization
from torch_panda.rendering import RendererName
from torch_panda.robots import Robot
from torch_panda.sensors import Sensor
from torch_panda.tasks import Task
from torch_panda.tasks.base import RewardFunction


class RobotTaskEnv(PicturedEnv, PersistentEnv, Closing):
    """Goal-conditioned environments of one robot and one task, stepped in parallel.

    What an environment draws depends on (``seed``, its index, the number of its
    episode) only, and an episode on what is drawn and on the actions only.

    A step takes ``action``, float32 in [-1, 1] (values beyond are clipped), and gives
    under ``next``: ``observation``, ``achieved_goal``, ``desired_goal`` (float32),
    ``success``, ``terminated``, ``truncated`` and ``done`` (bool) and ``reward``
    (float32), the last five of shape (*batch, 1). A step or reset that fails in one
    environment raises `WorkerError`, which names it; the others have gone on. Those of
    a reset that failed must be reset again.

    It serves one thread at a time: a call while another thread is in it raises
    `BulletError`. ``state_dict`` holds seeds and numbers of episodes, so that a run can
    be resumed at the next reset.

    Args:
        robot: the robot.
        task: the task.
        num_envs: number of environments: the batch size is [num_envs]; None makes one
            environment of batch size [].
        num_threads: threads that step them; None means one per core, at most
            ``num_envs``.
        seed: of all random draws; None takes one from the operating system.
        device: where the outputs are placed; None means the CPU. Physics and states
            stay on the CPU.
        max_episode_steps: steps until ``truncated``; None means the task's number.
        terminate_on_success: whether success ends an episode, as in panda-gym 3; the
            paper's episodes go on.
        physics: how Bullet integrates: "exact" (as panda-gym), "fast", or parameters.
        sensors: what to observe beside the state, each under its own keys: cameras
            (`CameraSensor`) and force sensors, these also by name.
        observe_state: observe ``observation``; the goals are there in any case.
        renderer: "tiny", Bullet's software renderer, or "egl", its OpenGL renderer.
        on_divergence: what happens when a step leaves an environment in a state that is
            not finite. It is put at the start of its next episode; then "raise" raises
            `BulletError`, while "reset" lets the step end there, ``truncated`` and no
            success; its reward is that of the start.
        randomize: physics that are drawn for every episode; None: they are the task's.

    Raises:
        ValueError: an argument is out of range.
        TypeError: an argument has a wrong type.
        RuntimeError: torch knows no such device, or EGL is asked for and does not work.

    Attributes:
        episodes: what runs the environments, without torchrl.
    """

    _supports_set_state = True

    @torch.inference_mode(False)  # or specs could not be used outside that mode
    def __init__(
        self,
        *,
        robot: Robot,
        task: Task,
        num_envs: int | None = None,
        num_threads: int | None = None,
        seed: int | None = None,
        device: torch.device | str | int | None = None,
        max_episode_steps: int | None = None,
        terminate_on_success: bool = False,
        physics: PhysicsParams | PhysicsName = "exact",
        sensors: Sequence[Sensor | str] = (),
        observe_state: bool = True,
        renderer: RendererName = "tiny",
        on_divergence: OnDivergence = "raise",
        randomize: Randomization | None = None,
    ) -> None:
        device = check_device(device)
        episodes = Episodes(
            robot=robot,
            task=task,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            max_episode_steps=max_episode_steps,
            terminate_on_success=terminate_on_success,
            physics=physics,
            sensors=sensors,
            renderer=renderer,
            on_divergence=on_divergence,
            randomize=randomize,
        )
        super().__init__(device=device, batch_size=episodes.batch_shape)
        self.episodes, self.num_envs = episodes, num_envs
        self.robot, self.task = robot, task
        self.physics = episodes.physics
        self.max_episode_steps = episodes.max_episode_steps
        self.terminate_on_success = terminate_on_success
        self.on_divergence = on_divergence
        self._observe_state = observe_state
        specs = Specs(episodes, device, observe_state=observe_state)
        self.observation_spec, self.action_spec = specs.observation, specs.action
        self.reward_spec, self.done_spec = specs.reward, specs.done
        # EnvBase closes a forgotten environment only if this is its own attribute.
        self.is_closed = False

    @property
    def num_threads(self) -> int:
        """Number of threads that step the environments."""
        return self.episodes.simulation.num_threads

    @property
    def compute_reward(self) -> RewardFunction:
        """The task's pure reward function; see `Task.compute_reward`."""
        return self.task.compute_reward

    @property
    def is_success(self) -> RewardFunction:
        """The task's pure success function; see `Task.is_success`."""
        return self.task.is_success

    # ---- what users call ---------------------------------------------------------

    def set_env_seed(self, env: int, seed: int) -> None:
        """Let environment ``env`` draw what the first one draws under ``seed``.

        For interfaces that seed environments one by one, such as Gymnasium's.

        Raises:
            ValueError: there is no such environment, or the seed is negative.
            TypeError: the seed is no integer.
        """
        self.episodes.seeds.restart_one(env, seed)

    def get_state(self, *, exact: bool = False) -> TensorDict:
        """The physical state, from which ``reset(state, set_state=True)`` starts.

        Args:
            exact: add the starts of the episodes and the actions since (``start_...``,
                ``actions``, ``num_actions``). Bullet remembers more than poses and
                velocities; from an exact state, which plays the actions once more,
                episodes go on bit for bit.

        Returns:
            ``joint_position`` and ``joint_velocity`` (*batch, n_joints),
            ``object_pose`` (*batch, n_objects, 7), ``object_velocity`` (*batch,
            n_objects, 6), ``desired_goal`` (*batch, goal_dim), all float64, and
            ``step_count`` (*batch, 1), int64. Where objects have joints, also
            ``object_joint_position`` and ``object_joint_velocity`` (*batch,
            n_object_joints); where physics vary, what they depend on:
            ``physics_parameters`` (*batch, k) float64, ``physics_seed`` (*batch, 1).

        Raises:
            BulletError: the environment is closed or was never reset.
        """
        return self._emit(self.episodes.get_state(exact=exact))

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free all clients and threads. Closing again does nothing."""
        self.episodes.close()
        self.is_closed = True

    def reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
        **kwargs: Any,  # noqa: ANN401 (torchrl's signature)
    ) -> TensorDictBase:
        """Start new episodes, as in torchrl.

        Args:
            tensordict: which environments, under ``_reset``; and a state to start from:
                what `get_state` returned, or some of its entries. It is left as it is.
            set_state: start from that state. What is left out is neutral (joints), zero
                (velocities) or sampled (objects, goal). None: if there is one.
            **kwargs: torchrl's other options.

        Returns:
            What the environments observe, and the state that was given, without what
            only an exact state has.

        Raises:
            ValueError: there is no state, or it cannot be one; or ``set_state`` is not
                given and the tensordict holds a state beside observations. torchrl's
                `TransformedEnv` and `ParallelEnv` do not pass states on.
        """
        # Within a rollout torchrl resets with what was observed, and says so.
        if set_state is None and not kwargs.get("select_reset_only", False):
            set_state = means_state(tensordict)
        if set_state and tensordict is not None:
            # torchrl writes what is observed into it, the goal as float32.
            tensordict = tensordict.copy()
        start = super().reset(tensordict, set_state=set_state, **kwargs)
        return start.exclude(*EXACT_KEYS) if set_state else start

    def rollout(
        self,
        max_steps: int,
        policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
        callback: Callable[..., Any] | None = None,
        **kwargs: Any,  # noqa: ANN401 (torchrl's signature)
    ) -> TensorDictBase:
        """Take steps and collect them, as in torchrl.

        Args:
            max_steps: how many, at most.
            policy: writes ``action``; None draws the actions that `rand_action` draws.
            callback: is called with the environment and each step.
            **kwargs: torchrl's other options.

        Returns:
            the steps, (*batch, time).
        """
        if policy is None and kwargs.get("actions") is None:
            # At every `rand_action` tensordict looks for pandas; where that is not
            # installed it takes 0.1 ms, of 0.3 between two steps.
            policy, kwargs["trust_policy"] = RandomPolicy(self.action_spec), True
        return super().rollout(max_steps, policy, callback, **kwargs)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act for one step, as in torchrl.

        Args:
            tensordict: of the environment's batch size, with ``action``; and, optional,
                which environments step, under ``_step``, and entries that are to stand
                under ``next`` beside what they observe.

        Returns:
            The same tensordict, with ``next``.
        """
        keys = tensordict.keys()
        is_plain = tensordict.batch_size == self.batch_size
        if not is_plain or "_step" in keys or "next" in keys:
            return super().step(tensordict)
        # torchrl would complete and reshape what `_step` returns: it is as it must be.
        return tensordict.set("next", self._step(tensordict))

    # ---- what torchrl calls ------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict.get("action", None)
        if isinstance(action, Tensor) and action.device.type != self.device.type:
            raise ValueError(
                f"the action must be on device {self.device}, got {action.device}"
            )
        stepped = self._read_mask(tensordict, "_step")
        return self._emit(self.episodes.step(action, stepped))

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
        **kwargs: Any,  # noqa: ANN401 (torchrl's signature)
    ) -> TensorDict:
        mask = None if tensordict is None else self._read_mask(tensordict, "_reset")
        envs = None if mask is None else indices(mask)
        given = {} if tensordict is None else tensordict
        return self._emit(self.episodes.reset(envs, given if set_state else None))

    def _set_seed(self, seed: int | None) -> None:
        self.episodes.seeds.restart(seed)

    # ---- tensors in and out ------------------------------------------------------

    def _read_mask(self, tensordict: TensorDictBase, key: str) -> Tensor | None:
        """A mask of environments, (n, 1) bool; None where there is none."""
        mask = tensordict.get(key, None)
        if mask is None:
            return None
        return mask.to("cpu").reshape(self.episodes.num_envs, 1)

    def _emit(self, values: Observed) -> TensorDict:
        """Shapes (n, ...) to (*batch, ...), on the environment's device."""
        if not self._observe_state:
            values.pop("observation", None)
        if self.num_envs is None:
            values = {key: value.squeeze(0) for key, value in values.items()}
        if self.device.type != "cpu":
            values = {key: value.to(self.device) for key, value in values.items()}
        # As torchrl makes its own: all that is checked otherwise is known to be right,
        # and takes ten times as long.
        return TensorDict._new_unsafe(values, self.batch_size, self.device)
