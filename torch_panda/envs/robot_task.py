"""A robot and a task, as one batched TorchRL environment."""

import functools
import operator
import secrets
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_panda.bullet import (
    BulletError,
    Camera,
    PhysicsClient,
    PhysicsName,
    PhysicsParams,
    Scene,
    VectorSimulation,
    read_physics,
)
from torch_panda.bullet.camera import resized
from torch_panda.bullet.renderers import RendererName
from torch_panda.closing import Closing
from torch_panda.envs.renderer import Renderer
from torch_panda.envs.senses import SenseOptions
from torch_panda.envs.state import read_state
from torch_panda.envs.twin import VisualTwin, segmentation_ids
from torch_panda.envs.window import Window
from torch_panda.robots import Robot
from torch_panda.tasks import Task
from torch_panda.tasks.base import RewardFunction

OnDivergence = Literal["raise", "reset"]


class RobotTaskEnv(EnvBase, Closing):
    """Goal-conditioned environments of one robot and one task, stepped in parallel.

    What an environment draws depends on (``seed``, its index, the number of its
    episode) only, and an episode on what is drawn and on the actions only.

    A step takes ``action``, float32 in [-1, 1] (values beyond are clipped), and gives
    under ``next``: ``observation``, ``achieved_goal``, ``desired_goal`` (float32),
    ``success``, ``terminated``, ``truncated`` and ``done`` (bool) and ``reward``
    (float32), the last five of shape (*batch, 1). A step or reset that fails in one
    environment raises `WorkerError`, which names it; the others have gone on.

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
        from_pixels: observe ``pixels``, uint8 (*batch, height, width, 3).
        pixels_only: leave ``observation`` out; the goals stay.
        camera: of what is observed; None means panda-gym's view in 64 x 64 pixels.
        render_size: height and width of what is observed [pixels], or both in one
            number; None means the camera's.
        depth: observe ``depth``, float32 (*batch, height, width, 1) [m]; see `Vision`.
        segmentation: observe ``segmentation``, int32 (*batch, height, width, 1), the
            body ids of ``segmentation_ids``.
        renderer: "tiny", Bullet's software renderer, or "egl", its OpenGL renderer.
        sensors: which of "wrist_force_torque", "finger_contact" and "joint_torque" to
            observe, each under its own key, float32; see `Touch`.
        on_divergence: what happens when a step leaves an environment in a state that is
            not finite. It is put at the start of its next episode; then "raise" raises
            `BulletError`, while "reset" lets the step end there, ``truncated``.

    Raises:
        ValueError: an argument is out of range.
        TypeError: an argument has a wrong type.
        RuntimeError: torch knows no such device, or EGL is asked for and does not work.
    """

    _supports_set_state = True

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
        from_pixels: bool = False,
        pixels_only: bool = False,
        camera: Camera | None = None,
        render_size: int | tuple[int, int] | None = None,
        depth: bool = False,
        segmentation: bool = False,
        renderer: RendererName = "tiny",
        sensors: Sequence[str] = (),
        on_divergence: OnDivergence = "raise",
    ) -> None:
        self._options = SenseOptions(
            from_pixels=from_pixels,
            pixels_only=pixels_only,
            camera=camera,
            render_size=render_size,
            depth=depth,
            segmentation=segmentation,
            renderer=renderer,
            sensors=sensors,
        )
        self._options.check(robot)
        _check_positive(num_envs=num_envs, num_threads=num_threads)
        _check_positive(max_episode_steps=max_episode_steps)
        if on_divergence not in get_args(OnDivergence):
            raise ValueError(
                f"on_divergence must be one of {get_args(OnDivergence)}, "
                f"got {on_divergence!r}"
            )
        batch_size = () if num_envs is None else (num_envs,)
        super().__init__(device=_check_device(device), batch_size=batch_size)
        self.robot = robot
        self.task = task
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps or task.max_episode_steps
        self.terminate_on_success = terminate_on_success
        self.on_divergence = on_divergence
        self.physics = read_physics(physics)
        self._set_seed(seed)
        count = num_envs or 1
        self._never_reset = set(range(count))
        self._step_count = torch.zeros(count, 1, dtype=torch.int64, device="cpu")
        self._goal = torch.zeros(
            count, task.goal_dim, dtype=torch.float64, device="cpu"
        )
        self._simulation = VectorSimulation(
            self._build_scene, count, num_threads=num_threads, physics=self.physics
        )
        try:
            self._renderer = Renderer(
                self._simulation, self._make_twin, renderer=renderer
            )
            self._senses = self._options.make(self._simulation, self._renderer, robot)
            self._make_specs()
            self._check_sizes()
        except BaseException:
            self._simulation.close()
            raise
        # EnvBase closes a forgotten environment only if this is its own attribute.
        self.is_closed = False

    @property
    def num_threads(self) -> int:
        """Number of threads that step the environments."""
        return self._simulation.num_threads

    @property
    def compute_reward(self) -> RewardFunction:
        """The task's pure reward function; see `Task.compute_reward`."""
        return self.task.compute_reward

    @property
    def is_success(self) -> RewardFunction:
        """The task's pure success function; see `Task.is_success`."""
        return self.task.is_success

    @functools.cached_property
    def segmentation_ids(self) -> dict[str, int]:
        """What the numbers in segmentations stand for, by name.

        ``nothing`` (-1), ``robot``, ``ground``, ``table``, and ``object``, or
        ``object1`` and ``object2``, unless the task's looks name bodies otherwise.
        """
        return segmentation_ids(self._build_scene)

    def set_env_seed(self, env: int, seed: int) -> None:
        """Let environment ``env`` draw what the first one draws under ``seed``.

        For interfaces that seed environments one by one, such as Gymnasium's.

        Raises:
            ValueError: the seed is negative.
        """
        self._streams[env] = (_check_seed(seed), 0)
        self._episodes[env] = 0

    def get_state(self) -> TensorDict:
        """The physical state, from which ``reset(state, set_state=True)`` starts.

        Returns:
            ``joint_position`` and ``joint_velocity`` (*batch, n_joints),
            ``object_pose`` (*batch, n_objects, 7), ``object_velocity`` (*batch,
            n_objects, 6), ``desired_goal`` (*batch, goal_dim), all float64, and
            ``step_count`` (*batch, 1), int64.

        Raises:
            BulletError: the environment is closed or was never reset.
        """
        state = self._current_state()
        self._check_was_reset()
        values = {key: self._emit(value.clone()) for key, value in state.items()}
        return TensorDict(values, batch_size=self.batch_size, device=self.device)

    def render(
        self,
        envs: int | Sequence[int] | None = None,
        *,
        camera: Camera | None = None,
        size: int | tuple[int, int] | None = None,
    ) -> Tensor:
        """Draw the environments as they are now.

        Args:
            envs: which, by index; None means all.
            camera: where from; None means `Camera`'s defaults, which are panda-gym's.
            size: height and width of the picture [pixels], or both in one number;
                None means the camera's.

        Returns:
            uint8, (num_envs, height, width, 3) or as many as were asked for;
            (height, width, 3) for one index or an environment of batch size [].

        Raises:
            BulletError: the environment is closed.
            ValueError: an index is out of range, or its environment was never reset.
            TypeError: an index is no integer.
        """
        self._check_open()
        camera = resized(camera or Camera(), size)
        if envs is None:
            chosen, single = range(len(self._goal)), self.num_envs is None
        else:
            chosen, single = np.atleast_1d(envs).tolist(), np.ndim(envs) == 0
        for env in chosen:
            known = _integer("an index", env) in range(len(self._goal))
            if not known or env in self._never_reset:
                raise ValueError(f"there is no environment {env} that was reset")
        pixels = self._renderer.picture(chosen, camera).to(self.device)
        return pixels[0] if single else pixels

    def open_window(self, camera: Camera | None = None) -> Window:
        """Open pybullet's GUI: ``show(i)`` of the result shows environment i.

        It needs a display. Close it, or use it under ``with``.

        Args:
            camera: where the view starts; None means `Camera`'s defaults.

        Raises:
            BulletError: there is no display, or the environment is closed.
        """
        self._check_open()
        return Window(self._simulation, self._build_scene, camera or Camera())

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free all clients and threads. Closing again does nothing."""
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)
            self._renderer.close()
            self._simulation.close()

    def __reduce__(self) -> tuple[Any, ...]:
        # Physics cannot be copied: a pickle holds how to build the environment anew.
        build = functools.partial(
            type(self),
            robot=self.robot,
            task=self.task,
            num_envs=self.num_envs,
            num_threads=self.num_threads,
            seed=self._seed,
            device=self.device,
            max_episode_steps=self.max_episode_steps,
            terminate_on_success=self.terminate_on_success,
            **vars(self._options),
            on_divergence=self.on_divergence,
            physics=self.physics,
        )
        return build, ()

    def reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
        **kwargs: Any,  # noqa: ANN401 (torchrl's signature)
    ) -> TensorDictBase:
        """Start new episodes, as in torchrl.

        Args:
            tensordict: which environments, under ``_reset``; with ``set_state``, what
                `get_state` returned, or some of its entries. It is left as it is.
            set_state: start from that state. What is left out is neutral (joints), zero
                (velocities) or sampled (objects, goal).
            **kwargs: torchrl's other options.

        Returns:
            What the environments observe, and the state that was given.

        Raises:
            ValueError: there is no state, or it cannot be one. torchrl's
                `TransformedEnv` and `ParallelEnv` do not pass states on.
        """
        if set_state and tensordict is not None:
            # torchrl writes what is observed into it, the goal as float32.
            tensordict = tensordict.copy()
        return super().reset(tensordict, set_state=set_state, **kwargs)

    # ---- what torchrl calls ------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._check_open()
        self._check_was_reset()
        action = self._read_action(tensordict)
        stepped = self._read_mask(tensordict, "_step")
        self.robot.set_action(action, self._simulation)
        self._step_count += 1 if stepped is None else stepped
        envs = None if stepped is None else _indices(stepped)
        self._simulation.step(self.robot.control_type, envs)
        if diverged := self._simulation.diverged():
            self._recover(diverged)
        for sense in self._senses:
            sense.after_step(range(len(self._goal)) if envs is None else envs)

        observation = self._observe()
        reward = self.compute_reward(
            observation["achieved_goal"], observation["desired_goal"]
        )
        if stepped is not None:
            reward = reward * stepped
        return self._make_tensordict({**observation, "reward": reward})

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
        **kwargs: Any,  # noqa: ANN401 (torchrl's signature)
    ) -> TensorDict:
        self._check_open()
        state = self._current_state()
        mask = None if tensordict is None else self._read_mask(tensordict, "_reset")
        envs = list(range(len(self._goal))) if mask is None else _indices(mask)
        envs = sorted({*envs, *self._never_reset})
        given = read_state(tensordict, like=state, envs=envs) if set_state else {}
        for env in envs:
            self._start_episode(env)
        for key, value in given.items():
            state[key][envs] = value
        self._place(envs)
        observation = self._observe()
        for key in ("terminated", "truncated", "done"):
            # A given state may be an episode's last; the next step ends it again.
            observation[key][envs] = False
        return self._make_tensordict(observation)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed  # what a pickle gives the copy
        if seed is None:
            # Different in every process, also in those that unpickle this environment.
            seed = secrets.randbits(63)
        count = self.num_envs or 1
        self._streams = [(_check_seed(seed), env) for env in range(count)]
        self._episodes = [0] * count

    # ---- parts of a step -----------------------------------------------------------

    def _build_scene(self, client: PhysicsClient) -> Scene:
        robot = self.robot.build(client)
        bodies = self.task.build(client)
        if "wrist_force_torque" in self._options.sensors:
            assert self.robot.wrist_joint is not None  # checked with the options
            client.enable_wrench_sensor(robot, self.robot.wrist_joint)
        return Scene(
            robot=robot,
            joints=tuple(j.index for j in client.joints(robot) if j.is_movable),
            ee_link=self.robot.ee_link,
            ee_orientation=self.robot.ee_orientation,
            num_arm_joints=self.robot.num_arm_joints,
            joint_forces=self.robot.joint_forces,
            objects=bodies.objects,
            targets=bodies.targets,
        )

    def _make_twin(self, mesh_cell: float) -> VisualTwin:
        return VisualTwin(
            self._build_scene,
            lambda client: self.task.build(client).targets,
            renderer=self._options.renderer,
            mesh_cell=mesh_cell,
        )

    def _start_episode(self, env: int) -> None:
        """Put the start of an environment's next episode into the state tensors."""
        simulation = self._simulation
        rng = np.random.default_rng((*self._streams[env], self._episodes[env]))
        self._episodes[env] += 1
        self._never_reset.discard(env)
        self._step_count[env] = 0
        _fill(self._goal[env], self.task.sample_goal(rng), "sample_goal")
        simulation.joint_position[env] = _double(self.robot.neutral_joint_position)
        simulation.joint_velocity[env] = 0.0
        if simulation.scene.objects:
            poses = self.task.sample_objects(rng)
            _fill(simulation.object_pose[env], poses, "sample_objects")
            simulation.object_velocity[env] = 0.0

    def _place(self, envs: list[int]) -> None:
        """Put robots, objects and markers where the state tensors say."""
        if self._simulation.scene.targets:
            target_pose = self.task.target_pose(self._goal[envs])
            self._simulation.target_pose[envs] = target_pose
        self._simulation.reset(envs)
        for sense in self._senses:
            sense.after_reset(envs)

    def _recover(self, envs: list[int]) -> None:
        """Start the next episode of environments whose physics has diverged."""
        for env in envs:
            self._simulation.rebuild(env)
            self._start_episode(env)
        self._place(envs)
        if self.on_divergence == "raise":
            raise BulletError(
                f"the physics of environments {envs} diverged: their state was not "
                f"finite; they are at the start of their next episode"
            )
        self._step_count[envs] = self.max_episode_steps

    def _observe(self) -> dict[str, Tensor]:
        """Observation, goals, success and ends, (n, ...), in new tensors."""
        simulation = self._simulation
        observation = torch.cat(
            (self.robot.observation(simulation), self.task.observation(simulation)),
            dim=1,
        )
        achieved_goal = self.task.achieved_goal(simulation).float()
        desired_goal = self._goal.float()
        success = self.is_success(achieved_goal, desired_goal)
        started = self._step_count > 0
        truncated = self._step_count >= self.max_episode_steps
        terminated = success & started & self.terminate_on_success
        sensed: dict[str, Tensor] = {}
        for sense in self._senses:
            sensed |= sense.observe()
        if not self._options.pixels_only:
            sensed["observation"] = observation.float()
        return {
            **sensed,
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": success,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }

    def _current_state(self) -> dict[str, Tensor]:
        """The tensors that hold the physical state, (n, ...); not copies."""
        self._check_open()
        simulation = self._simulation
        return {
            "joint_position": simulation.joint_position,
            "joint_velocity": simulation.joint_velocity,
            "object_pose": simulation.object_pose,
            "object_velocity": simulation.object_velocity,
            "desired_goal": self._goal,
            "step_count": self._step_count,
        }

    # ---- tensors in and out ----------------------------------------------------------

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.device

        def numbers(size: int) -> Unbounded:
            return Unbounded((*batch, size), device=device, dtype=torch.float32)

        def flag() -> Binary:
            return Binary(shape=(*batch, 1), device=device, dtype=torch.bool)

        size = self.robot.observation_dim + self.task.observation_dim
        self.observation_spec = Composite(
            observation=numbers(size),
            achieved_goal=numbers(self.task.goal_dim),
            desired_goal=numbers(self.task.goal_dim),
            success=flag(),
            shape=batch,
            device=device,
        )
        if self._options.pixels_only:
            del self.observation_spec["observation"]
        for sense in self._senses:
            self.observation_spec.update(sense.spec(batch, device))
        self.action_spec = Bounded(
            low=-1.0,
            high=1.0,
            shape=(*batch, self.robot.action_dim),
            device=device,
            dtype=torch.float32,
        )
        self.reward_spec = numbers(1)
        self.done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), shape=batch, device=device
        )

    def _read_action(self, tensordict: TensorDictBase) -> Tensor:
        """The clipped action on the CPU: (n, action_dim) float32."""
        action = tensordict.get("action", None)
        shape = (*self.batch_size, self.robot.action_dim)
        if not isinstance(action, Tensor):
            raise ValueError(f"the action must be a tensor of shape {shape}, got none")
        if tuple(action.shape) != shape:
            raise ValueError(
                f"the action must have shape {shape}, got {tuple(action.shape)}"
            )
        if not action.dtype.is_floating_point:
            raise TypeError(f"the action must be float32, got {action.dtype}")
        if action.device.type != self.device.type:
            raise ValueError(
                f"the action must be on device {self.device}, got {action.device}"
            )
        action = action.detach().to("cpu").reshape(-1, shape[-1])
        if not action.isfinite().all():
            env = int((~action.isfinite()).any(dim=1).nonzero()[0])
            raise ValueError(
                f"the action of environment {env} is not finite: {action[env].tolist()}"
            )
        # Clipped first: what is large in float64 would be infinite in float32.
        return action.clamp(-1.0, 1.0).float()

    def _read_mask(self, tensordict: TensorDictBase, key: str) -> Tensor | None:
        """A mask of environments, (n, 1) bool; None where there is none."""
        mask = tensordict.get(key, None)
        if mask is None:
            return None
        return mask.to("cpu").reshape(len(self._goal), 1)

    def _emit(self, value: Tensor) -> Tensor:
        """Shape (n, ...) to (*batch, ...), on the environment's device."""
        value = value if self.batch_size else value.squeeze(0)
        return value.to(self.device)

    def _make_tensordict(self, values: dict[str, Tensor]) -> TensorDict:
        return TensorDict(
            {key: self._emit(value) for key, value in values.items()},
            batch_size=self.batch_size,
            device=self.device,
        )

    def _check_open(self) -> None:
        if self.is_closed:
            raise BulletError("the environment is closed")

    def _check_was_reset(self) -> None:
        if self._never_reset:
            raise BulletError(
                f"environments {sorted(self._never_reset)} were never reset: call "
                f"reset first"
            )

    def _check_sizes(self) -> None:
        """Make sure that robot and task observe as many numbers as they say."""
        robot, task = self.robot, self.task
        for function, size in (
            (robot.observation, robot.observation_dim),
            (task.observation, task.observation_dim),
            (task.achieved_goal, task.goal_dim),
        ):
            expected = (len(self._goal), size)
            shape = tuple(function(self._simulation).shape)
            if shape != expected:
                raise ValueError(
                    f"{function.__qualname__} must return shape {expected}, got {shape}"
                )


def _double(values: object) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64, device="cpu")


def _fill(row: Tensor, values: object, function: str) -> None:
    """Take what a task has drawn for one environment, (...)."""
    drawn = _double(values)
    if drawn.shape != row.shape or not drawn.isfinite().all():
        raise ValueError(
            f"{function} must return finite numbers of shape {tuple(row.shape)}, "
            f"got {values}"
        )
    row.copy_(drawn)


def _indices(mask: Tensor) -> list[int]:
    return mask.flatten().nonzero().flatten().tolist()


def _check_seed(seed: int) -> int:
    number = _integer("seed", seed)
    if number < 0:
        raise ValueError(f"seed must be a non-negative integer, got {seed}")
    return number


def _integer(name: str, value: int) -> int:
    if not isinstance(value, bool):  # torch accepts none of these as a size
        with suppress(TypeError):
            return operator.index(value)
    raise TypeError(f"{name} must be an integer, got {value!r}")


def _check_device(device: torch.device | str | int | None) -> torch.device:
    device = torch.device("cpu" if device is None else device)
    try:
        torch.empty(0, device=device)
    except AssertionError as error:  # torch was built without it
        raise RuntimeError(f"device {device} does not work: {error}") from None
    return device


def _check_positive(**arguments: int | None) -> None:
    for name, value in arguments.items():
        if value is not None and not 1 <= _integer(name, value) <= sys.maxsize:
            raise ValueError(
                f"{name} must be None or from 1 to {sys.maxsize}, got {value}"
            )
