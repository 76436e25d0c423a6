"""One robot and one task as a batched TorchRL environment."""

import functools
import inspect
import json
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from typing_extensions import Self

from torch_panda.arguments import check_no_option
from torch_panda.bullet import PhysicsName, PhysicsParams
from torch_panda.checks import check_device
from torch_panda.envs.episodes import Episodes, Observed, OnDivergence, indices
from torch_panda.envs.goal_observation import GoalName, apply_to_observations
from torch_panda.envs.randomization import Randomization
from torch_panda.envs.state import EXACT_KEYS, is_state, unpack_state
from torch_panda.extras import install_command
from torch_panda.rendering import Camera, RendererName
from torch_panda.rendering.camera import resized
from torch_panda.robots import Robot
from torch_panda.sensors import Entry, Sensor
from torch_panda.tasks import Task
from torch_panda.tasks.base import RewardFunction

if TYPE_CHECKING:  # imported at their first use; WebViewer needs an extra
    from torch_panda.rendering.web_viewer import WebViewer
    from torch_panda.rendering.window import Window


class RobotTaskEnv(EnvBase):
    """Goal-conditioned environments of one robot and one task, stepped in parallel.

    The random draws of an environment depend on (``seed``, index of the environment,
    number of the episode) only. An episode depends on these draws and on the actions
    only.

    A step takes ``action``, float32, which is clipped to [-1, 1]. It writes under
    ``next``: ``observation``, ``achieved_goal``, ``desired_goal`` (float32),
    ``reward`` (*batch, 1) float32, and ``success``, ``terminated``, ``truncated`` and
    ``done`` (*batch, 1) bool.

    If a step fails in one environment, `WorkerError` names it, and all others finish
    the step. If a reset fails in one environment, all environments of this reset need
    another reset.

    One thread at a time may use an environment: a call raises `BulletError` while a
    call of another thread is running.

    The state of Bullet cannot be copied, so a pickle holds only the class, the
    arguments, and the seed of the constructor or of the last `set_seed`. An unpickled
    environment builds its own clients and starts with the first episode of this seed.

    ``state_dict`` holds the seeds and the episode numbers, but not the state of the
    running episodes. After `load_state_dict`, the next reset starts the episode that
    would have followed the running one.

    Args:
        robot: The robot.
        task: The task.
        num_envs: Number of environments stepped in parallel; the batch size is
            [num_envs]. None makes one environment of batch size [].
        num_threads: Number of threads that step the environments; None means one per
            core that the process may use, at most ``num_envs``.
        seed: Seed of all random draws; None draws one from the operating system. Two
            environments with the same seed play the same episodes, so give each worker
            process a seed of its own.
        device: Device of all outputs, also of `get_state`; None means the CPU. The
            physics is computed on the CPU.
        max_episode_steps: Number of steps after which an episode is ``truncated``;
            None means the task's number.
        terminate_on_success: Whether success ends an episode, as in panda-gym 3. In
            panda-gym's paper, episodes continue after success.
        physics: How Bullet integrates: "exact" as in panda-gym, "fast", or parameters.
        sensors: Sensors to observe in addition to ``observation``, each under its own
            keys. A sensor without arguments may be given by its name.
        observe_state: Whether the outputs have ``observation``. Set False, for example,
            to learn from pictures only. The goals are always observed.
        renderer: "tiny", Bullet's software renderer, or "egl", its OpenGL renderer.
        on_divergence: What happens when a step leaves an environment in a state that
            is not finite. In any case, the environment starts its next episode.
            "raise": the step raises `BulletError`. "reset": the step returns the first
            observation of the next episode, but with the ``desired_goal`` of the ended
            episode. The reward is computed from these two, ``success`` is False and
            ``truncated`` is True.
        randomize: Ranges from which the physics of every episode are drawn; None keeps
            the physics of the task.
        goal: "task" observes the task's goals. "observation" makes ``achieved_goal``
            and ``desired_goal`` full observations: the desired goal is the observation
            of a state in which the task's goal is reached, with the objects at their
            goals and at rest, and the end-effector in its neutral pose (in Reach at the
            goal). Reward and success stay the task's, computed from the numbers at
            `goal_indices`. The ``desired_goal`` in states (`get_state`, `reset`) stays
            the task's goal.

    Raises:
        ValueError: An argument is out of range.
        TypeError: An argument has a wrong type.
        RuntimeError: EGL does not work.
    """

    _arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:  # noqa: ANN401 (a subclass's)
        """Remember the arguments, also those of a subclass, for pickles and repr."""
        env = super().__new__(cls, *args, **kwargs)
        env._arguments = (args, kwargs)
        return env

    # Leave inference mode, because specs made in this mode cannot be used outside it.
    @torch.inference_mode(False)
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
        goal: GoalName = "task",
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
            goal=goal,
        )
        super().__init__(device=device, batch_size=episodes.batch_shape)
        self._episodes, self._num_envs = episodes, num_envs
        self._env_id: str | None = None
        self._has_state_transform = False  # `StateTransform` sets it
        self._goal, self._observe_state = goal, observe_state
        self._declare_specs()
        # torchrl's default is True, which would keep `EnvBase.__del__` from closing a
        # forgotten environment.
        self.is_closed = False

    @property
    def num_threads(self) -> int:
        """Number of threads that step the environments."""
        return self.episodes.simulation.num_threads

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse assignments without effect: of arguments, and of a part's options."""
        if name in _FIXED:
            raise AttributeError(
                f"{name} of a live environment cannot be changed: make a new "
                f"environment"
            )
        if "_episodes" in vars(self) and not name.startswith("_"):
            check_no_option(name, "env", task=self.task, robot=self.robot)
        super().__setattr__(name, value)

    @property
    def episodes(self) -> Episodes:
        """The same environments as plain torch, without torchrl's interface."""
        return self._episodes

    @property
    def env_id(self) -> str | None:
        """Id with which `torch_panda.make` made the environment, else None."""
        return self._env_id

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self._episodes.robot

    @property
    def task(self) -> Task:
        """The task."""
        return self._episodes.task

    @property
    def num_envs(self) -> int | None:
        """Number of environments; None if the batch size is []."""
        return self._num_envs

    @property
    def physics(self) -> PhysicsParams:
        """How Bullet integrates."""
        return self._episodes.physics

    @property
    def goal(self) -> GoalName:
        """Whether goals are the task's goals or full observations."""
        return self._goal

    @property
    def render_fps(self) -> int:
        """Frames per second of a video in real time that has one frame per step."""
        return round(1 / self.physics.ctrl_dt)

    @property
    def max_episode_steps(self) -> int:
        """Number of steps after which an episode is ``truncated``."""
        return self.episodes.max_episode_steps

    @property
    def terminate_on_success(self) -> bool:
        """Whether success ends an episode."""
        return self.episodes.terminate_on_success

    @property
    def on_divergence(self) -> OnDivergence:
        """Whether a step that diverges raises an error or resets the environment."""
        return self.episodes.on_divergence

    @property
    def goal_indices(self) -> tuple[int, ...] | None:
        """Column of ``observation`` of each number of the task's achieved goal.

        None if the observation does not contain the achieved goal, or if the task does
        not declare `Task.goal_entries`.
        """
        return self.episodes.goal_indices

    @property
    def compute_reward(self) -> RewardFunction:
        """The pure reward function of ``achieved_goal`` and ``desired_goal``.

        It maps (..., goal size) to (..., 1); see `Task.compute_reward`.
        """
        return self._as_function_of_observed_goals(self.task.compute_reward)

    @property
    def is_success(self) -> RewardFunction:
        """The pure success function of ``achieved_goal`` and ``desired_goal``.

        It maps (..., goal size) to (..., 1); see `Task.is_success`.
        """
        return self._as_function_of_observed_goals(self.task.is_success)

    def _as_function_of_observed_goals(
        self, function: RewardFunction
    ) -> RewardFunction:
        """Convert a function of the task's goals to one of the observed goals."""
        if self.goal == "task":
            return function
        goal_indices, size = self.episodes.goal_indices, self.episodes.goal_dim
        assert goal_indices is not None  # `Episodes` has checked this
        return functools.partial(apply_to_observations, function, goal_indices, size)

    def __repr__(self) -> str:
        """The class, the arguments that are not the defaults, and Bullet's solver."""
        args, kwargs = self._arguments
        parameters = inspect.signature(type(self).__init__).parameters
        defaults = {name: parameter.default for name, parameter in parameters.items()}
        arguments = [repr(value) for value in args]
        arguments += [
            f"{name}={value!r}"
            for name, value in kwargs.items()
            if value != defaults.get(name)
        ]
        call = f"{type(self).__name__}({', '.join(arguments)})"
        from torch_panda.bullet import solver  # already imported by the clients

        return f"{call} [solver: {solver.activate().name}]"

    # ---- start and act -------------------------------------------------------------

    def reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
        **kwargs: Any,  # noqa: ANN401 (torchrl's signature)
    ) -> TensorDictBase:
        """Start new episodes, as in torchrl.

        Args:
            tensordict: May hold ``_reset``, a mask of the environments to reset, and a
                state to start from: the result of `get_state`, or some of its entries.
                Without a state, the call writes the observations into this tensordict
                and returns it.
            set_state: Whether to start from this state. Entries that the state lacks
                start as in any new episode. None starts from the state if the
                tensordict holds one.
            **kwargs: Other options of torchrl.

        Returns:
            The observed entries of all environments. After a start from a state, also
            the entries of this state, except those that `get_state` adds for
            ``exact=True``.

        Raises:
            ValueError: The state is missing or wrong; or ``set_state`` is None and the
                tensordict holds observations and a state.
            NotImplementedError: ``set_state`` is true, and torchrl's `TransformedEnv`
                or `ParallelEnv` would not pass the state on (see `StateTransform`).
            TypeError: An option is unknown, for example ``seed``.
        """
        # In a rollout, torchrl passes the last observations with `select_reset_only`.
        # Such a reset does not start from a state.
        if set_state is None and not kwargs.get("select_reset_only", False):
            set_state = is_state(tensordict, self.episodes.entries)
        if not set_state or tensordict is None or kwargs.get("select_reset_only"):
            return super().reset(tensordict, set_state=set_state, **kwargs)
        # torchrl's reset would keep the entries of this tensordict for environments
        # that are not reset. But this tensordict holds a state, whose
        # ``desired_goal`` is not the goal of these environments.
        if tensordict.batch_size != self.batch_size:
            raise ValueError(
                f"the state must have batch size {self.batch_size}, got "
                f"{tensordict.batch_size}"
            )
        start = self._reset(tensordict, set_state=True, **kwargs)
        return tensordict.exclude("_reset", *EXACT_KEYS).update(start)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act for one step, as in torchrl.

        Args:
            tensordict: Holds ``action``. It may also hold ``_step``, a mask of the
                environments that take the step, and entries under ``next``, which are
                kept.

        Returns:
            The same tensordict, with ``next``.
        """
        keys = tensordict.keys()
        if (
            tensordict.batch_size != self.batch_size
            or "_step" in keys
            or "next" in keys
        ):
            return super().step(tensordict)
        # The result has all keys, so skip torchrl's search for missing ones.
        return tensordict.set("next", self._step(tensordict))

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Draw the random actions that torchrl would draw, in a fifth of its time.

        Args:
            tensordict: The tensordict to write ``action`` into; None makes a new one.
        """
        if tensordict is None:
            tensordict = TensorDict({}, self.batch_size, device=self.device)
        spec = self.action_spec
        action = torch.rand(spec.shape, dtype=spec.dtype, device=self.device) * 2 - 1
        return tensordict.set("action", action)

    def set_env_seed(self, env: int, seed: int) -> None:
        """Seed one environment.

        From its next reset, it plays the episodes of environment 0 of a `RobotTaskEnv`
        that was made with ``seed``. Gymnasium, for example, seeds each environment
        separately.

        Raises:
            ValueError: The index is out of range, or the seed is negative.
            TypeError: The seed is not an integer.
        """
        self.episodes.set_env_seed(env, seed)

    # ---- states, saving and pickling -----------------------------------------------

    def get_state(self, *, exact: bool = False) -> TensorDict:
        """The physical state, from which ``reset(state, set_state=True)`` starts.

        Args:
            exact: Add the starts of the episodes and the actions since, under
                ``start_...``, ``actions`` and ``num_actions``. A reset to an exact
                state repeats these actions, and the episode then continues bit for
                bit. Bullet remembers more than poses and velocities, so after a reset
                to a plain state, the episode continues only approximately.

        Returns:
            ``joint_position`` and ``joint_velocity`` (*batch, n_joints),
            ``object_pose`` (*batch, n_objects, 7), ``object_velocity`` (*batch,
            n_objects, 6) and ``desired_goal`` (*batch, `Task.goal_dim`), all float64,
            and ``step_count`` (*batch, 1), int64. If objects have joints, also
            ``object_joint_position`` and ``object_joint_velocity`` (*batch,
            n_object_joints). If ``randomize`` has ranges, also ``physics_parameters``
            (*batch, k) float64. If the task overrides `Task.randomize`, also
            ``physics_seed`` (*batch, 1) int64.

        Raises:
            BulletError: The environment is closed or needs a reset; or an episode is
                too long for an exact state, or the robot's ``action_scale`` changed
                during the episode.
        """
        return self._emit(self.episodes.get_state(exact=exact))

    def get_extra_state(self) -> Tensor:
        """Seeds and episode numbers for ``state_dict``, as JSON in a uint8 tensor.

        It is a tensor because torchrl's `EnvCreator` copies the ``state_dict`` of its
        first environment into all others, but leaves out tensors. `ParallelEnv` wraps
        every lambda in an `EnvCreator`, so with another type all its workers would play
        the same episodes.
        """
        text = json.dumps(self.episodes.seed_state())
        return torch.tensor([*text.encode()], dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore seeds and episode numbers. The next reset starts the next episode."""
        self.episodes.load_seed_state(json.loads(bytes(state.tolist())))

    def load_state_dict(
        self,
        state_dict: Mapping[str, Any],
        *args: Any,  # noqa: ANN401 (torch's signature)
        **kwargs: Any,  # noqa: ANN401
    ) -> object:
        """Load a ``state_dict``. An empty one changes nothing.

        Collectors of torchrl pass an empty one, because their ``state_dict`` does not
        include that of the environment. So does `EnvCreator` (see `get_extra_state`).

        Raises:
            ValueError: The ``state_dict`` holds a different number of environments.
        """
        if not state_dict:
            return None
        return super().load_state_dict(state_dict, *args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        seed = self.episodes.seed
        settings = (seed, self.device, self.env_id)
        return _rebuild, (type(self), *self._arguments, *settings)

    # ---- pictures ------------------------------------------------------------------

    @functools.cached_property
    def segmentation_ids(self) -> dict[str, int]:
        """The numbers in segmentations, by name.

        The shipped tasks have ``nothing`` (-1), ``robot``, ``ground``, ``table``, and
        the objects, such as ``object`` in Push, and ``object1`` and ``object2`` in
        Stack. A task can give a body another name with `Visual.name`; equal names are
        numbered. Further bodies are named by their ids, such as ``body3``.
        """
        from torch_panda.rendering.renderer import segmentation_ids

        return segmentation_ids(self.episodes.simulation)

    def render(
        self,
        envs: int | Sequence[int] | None = None,
        *,
        camera: Camera | None = None,
        size: int | tuple[int, int] | None = None,
    ) -> Tensor:
        """Render the environments as they are now.

        Args:
            envs: Index or indices of the environments; None means all.
            camera: The camera; None means a `Camera` with panda-gym's defaults.
            size: Height and width of the picture [pixels], or both in one number; None
                means the camera's.

        Returns:
            uint8, (number of environments, height, width, 3); (height, width, 3) for
            one index or an environment of batch size [].

        Raises:
            BulletError: The environment is closed, or another thread is using it.
            ValueError: An index is out of range, or its environment needs a reset.
            TypeError: An index is not an integer.
        """
        camera, episodes = resized(camera or Camera(), size), self.episodes
        if envs is None:
            chosen, is_single = range(episodes.num_envs), self.num_envs is None
        else:
            chosen, is_single = np.atleast_1d(envs).tolist(), np.ndim(envs) == 0
        with episodes.exclusive():
            for env in chosen:
                episodes.check_index(env)
            pixels = episodes.renderer.render(chosen, camera).to(self.device)
        return pixels[0] if is_single else pixels

    def open_window(self, camera: Camera | None = None) -> "Window":
        """Open pybullet's GUI. ``show(i)`` of the result shows environment i.

        It needs a display. Close it, or use it as a context manager.

        Args:
            camera: The camera with which the view starts; None means `Camera`'s
                defaults.

        Raises:
            BulletError: There is no display, or the environment is closed.
        """
        from torch_panda.rendering.window import Window

        episodes = self.episodes
        with episodes.exclusive():
            return Window(episodes.simulation, camera or Camera())

    def open_viewer(
        self,
        camera: Camera | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        allowed_hosts: Sequence[str] = (),
    ) -> "WebViewer":
        """Serve the scene to browsers, in three dimensions; needs the extra ``viewer``.

        Call ``update()`` of the result after each reset and step, so that the page
        shows the present state. The slider of the page goes back over the episode.
        Close the viewer, or use it as a context manager.

        Args:
            camera: The camera with which the view starts; None means `Camera`'s
                defaults.
            host: Address at which the server listens; "0.0.0.0" lets other machines
                connect.
            port: First port to try; the viewer takes the next free one, see ``url``.
            allowed_hosts: Names of this machine under which browsers may open the page,
                in addition to ``host`` and the loopback names. Requests under any other
                name are refused, and so are requests that a page of another site sends.

        Raises:
            ImportError: viser or yourdfpy is not installed.
            BulletError: The environment is closed.
        """
        if find_spec("yourdfpy") is None:
            raise ImportError(
                f"viewers need viser and yourdfpy: {install_command('viewer')}"
            )
        from torch_panda.rendering.web_viewer import WebViewer

        episodes = self.episodes
        with episodes.exclusive():
            return WebViewer(
                episodes.simulation,
                episodes.progress,
                exclusive=episodes.exclusive,
                title=type(episodes.task).__name__,
                camera=camera or Camera(),
                host=host,
                port=port,
                allowed_hosts=allowed_hosts,
            )

    # ---- closing -------------------------------------------------------------------

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free all clients and threads. Closing again does nothing."""
        self.episodes.close()
        self.is_closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- called by torchrl ---------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict.get("action", None)
        is_on_cpu = isinstance(action, Tensor) and action.is_cpu
        if isinstance(action, Tensor) and is_on_cpu != (self.device.type == "cpu"):
            raise ValueError(
                f"the action must be on device {self.device}, got {action.device}"
            )
        step_mask = self._read_mask(tensordict, "_step")
        return self._emit(self.episodes.step(action, step_mask))

    def _reset(  # type: ignore[override]  # other options are refused
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
    ) -> TensorDict:
        mask = None if tensordict is None else self._read_mask(tensordict, "_reset")
        envs = None if mask is None else indices(mask)
        state = unpack_state({} if tensordict is None else tensordict)
        return self._emit(self.episodes.reset(envs, state if set_state else None))

    @property
    def _supports_set_state(self) -> bool:  # type: ignore[override]  # an attribute
        """Whether torchrl's wrappers may pass ``set_state=True`` on.

        A `TransformedEnv` would lose the state, unless a `StateTransform` carries it.
        torchrl then raises `NotImplementedError`.
        """
        is_transformed = "_inplace_update" in vars(self)  # `TransformedEnv` sets it
        return self._has_state_transform or not is_transformed

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        """Let torchrl's wrappers start from a state with ``set_state=True`` only.

        torchrl would also take the ``step_count`` of a `StepCounter` for a state.
        """
        return False

    def _set_seed(self, seed: int | None) -> None:
        self.episodes.set_seed(seed)

    def _reset_proc_data(
        self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Write the first observations into the caller's tensordict, as in torchrl.

        torchrl's own method writes zeros for environments that are not reset, where the
        tensordict lacks an entry. `_reset` returns the entries of all environments, so
        write these.
        """
        if tensordict is None:
            return tensordict_reset
        for key, value in tensordict_reset.items():
            if tensordict.get(key, None) is None:
                tensordict.set(key, value)
        return super()._reset_proc_data(tensordict, tensordict_reset)

    def _create_done_specs(self) -> None:
        """Do nothing, because the done specs are complete.

        torchrl's method leaves a cycle of references behind, which keeps a forgotten
        environment alive until the garbage collector finds it.
        """

    # ---- tensors in and out ----------------------------------------------------------

    def _declare_specs(self) -> None:
        """Set the specs, which follow from the sizes that the parts declare."""
        batch, device, episodes = self.batch_size, self.device, self.episodes
        robot, task = self.robot, self.task

        def spec(entry: Entry) -> TensorSpec:
            shape, dtype = torch.Size((*batch, *entry.shape)), entry.dtype
            if dtype == torch.bool:
                return Binary(shape=shape, device=device, dtype=dtype)
            if entry.high is None:
                return Unbounded(shape, dtype=dtype, device=device)
            return Bounded(0, entry.high, shape, dtype=dtype, device=device)

        def numbers(size: int) -> TensorSpec:
            return spec(Entry((size,), torch.float32))

        flag = Entry((1,), torch.bool)
        observed = {
            "achieved_goal": numbers(episodes.goal_dim),
            "desired_goal": numbers(episodes.goal_dim),
            "success": spec(flag),
        }
        if self._observe_state:
            size = robot.observation_dim + task.observation_dim
            observed["observation"] = numbers(size)
        observed |= {key: spec(entry) for key, entry in episodes.entries.items()}
        ends = {key: spec(flag) for key in ("done", "terminated", "truncated")}
        self.observation_spec = Composite(observed, shape=batch, device=device)
        self.action_spec = Bounded(
            low=-1.0,
            high=1.0,
            shape=torch.Size((*batch, robot.action_dim)),
            device=device,
            dtype=torch.float32,
        )
        self.reward_spec = numbers(1)
        self.done_spec = Composite(  # type: ignore[misc]  # it has a setter
            ends, shape=batch, device=device
        )

    def _read_mask(self, tensordict: TensorDictBase, key: str) -> Tensor | None:
        """The mask under a key, (n, 1) bool, or None if the key is missing."""
        mask = tensordict.get(key, None)
        if mask is None:
            return None
        return mask.to("cpu").reshape(self.episodes.num_envs, 1)

    def _emit(self, values: Observed) -> TensorDict:
        """Convert entries (n, ...) to (*batch, ...), on the environment's device."""
        if not self._observe_state:
            values.pop("observation", None)
        if self.num_envs is None:
            values = {key: value.squeeze(0) for key, value in values.items()}
        if self.device.type != "cpu":
            values = {key: value.to(self.device) for key, value in values.items()}
        # torchrl also makes its tensordicts by this private function. The public
        # constructor would take ten times as long, because of its checks.
        return TensorDict._new_unsafe(values, self.batch_size, self.device)


# Attributes that cannot be assigned: the arguments, except the device, which `to`
# changes.
_FIXED = {*inspect.signature(RobotTaskEnv.__init__).parameters, "episodes"}
_FIXED -= {"self", "device"}


def _rebuild(
    env_class: type[RobotTaskEnv],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    seed: int | None,
    device: torch.device,
    env_id: str | None,
) -> RobotTaskEnv:
    """Rebuild a pickled environment."""
    env = env_class(*args, **kwargs)
    env._env_id = env_id
    env.episodes.set_seed(seed)
    return env.to(device)
