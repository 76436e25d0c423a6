"""Episodes of a robot at a task: start, act, observe. Plain torch, without torchrl."""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from torch import Tensor

from torch_panda.bullet import (
    BulletError,
    PhysicsName,
    PhysicsParams,
    ThreadGuard,
    VectorSimulation,
    read_physics,
)
from torch_panda.closing import Closing
from torch_panda.envs.action import read_action
from torch_panda.envs.checks import check_functions, check_kinds, check_positive
from torch_panda.envs.history import History
from torch_panda.envs.hooks import TaskHooks
from torch_panda.envs.scene import TaskScene
from torch_panda.envs.seeds import EpisodeSeeds, integer
from torch_panda.envs.start import draw_start
from torch_panda.envs.state import GivenState, check_rotations, read_state
from torch_panda.envs.variation import Variation
from torch_panda.randomization import Randomization
from torch_panda.rendering import (
    Camera,
    RendererName,
    VectorRenderer,
    Window,
    check_renderer,
    segmentation_ids,
)
from torch_panda.robots import Robot
from torch_panda.sensors import Observer, Sensor, join_entries, read_sensors
from torch_panda.tasks import Task

if TYPE_CHECKING:  # needs an extra
    from torch_panda.rendering.web_viewer import WebViewer

OnDivergence = Literal["raise", "reset"]

Observed = dict[str, Tensor]  # by entry, (n, ...), in new tensors


class Episodes(Closing):
    """n environments of one robot and one task; see `RobotTaskEnv` for the arguments.

    Tensors are on the CPU and have n rows, also where ``num_envs`` is None: then n = 1,
    and only actions and states that are given have the batch shape ().

    A call while another thread is in it raises `BulletError`.
    """

    @torch.inference_mode(False)  # or its tensors could only be changed in that mode
    def __init__(
        self,
        *,
        robot: Robot,
        task: Task,
        num_envs: int | None = None,
        num_threads: int | None = None,
        seed: int | None = None,
        max_episode_steps: int | None = None,
        terminate_on_success: bool = False,
        physics: PhysicsParams | PhysicsName = "exact",
        sensors: Sequence[Sensor | str] = (),
        renderer: RendererName = "tiny",
        on_divergence: OnDivergence = "raise",
        randomize: Randomization | None = None,
    ) -> None:
        check_kinds(robot, task)
        if not isinstance(randomize, Randomization | None):
            raise TypeError(f"randomize must be a Randomization, got {randomize!r}")
        check_positive(
            num_envs=num_envs,
            num_threads=num_threads,
            max_episode_steps=max_episode_steps,
        )
        check_renderer(renderer)
        if on_divergence not in get_args(OnDivergence):
            raise ValueError(
                f"on_divergence must be one of {get_args(OnDivergence)}, "
                f"got {on_divergence!r}"
            )
        n = num_envs or 1
        self.robot, self.task = robot, task
        self._control = robot.controller
        self.batch_shape = () if num_envs is None else (n,)
        self.max_episode_steps = max_episode_steps or task.max_episode_steps
        self.terminate_on_success = terminate_on_success
        self.on_divergence = on_divergence
        self.physics = read_physics(physics)
        self.seeds = EpisodeSeeds(n, seed)
        self.is_closed = False
        self._guard = ThreadGuard()
        self._never_reset = set(range(n))
        self._step_count = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
        self._goal = torch.zeros(n, task.goal_dim, dtype=torch.float64, device="cpu")
        sensors = read_sensors(sensors, robot)
        self._build_scene = TaskScene(robot, task, sensors)
        self.simulation = VectorSimulation(
            self._build_scene, n, num_threads=num_threads, physics=self.physics
        )
        try:
            check_functions(robot, task, self.simulation, self._goal)
            self._renderer = VectorRenderer(
                self.simulation, self._build_scene, renderer=renderer
            )
            self._readings = [
                sensor.attach(self.simulation, self._renderer, robot)
                for sensor in sensors
            ]
            self._hooks = TaskHooks(task, self.simulation, robot.action_dim)
            self._variation = Variation(
                randomize,
                robot,
                task,
                self.simulation,
                self.physics,
                has_hook=self._hooks.randomizes,
            )
            observers: list[Observer] = [*self._readings, self._hooks, self._variation]
            self.entries = join_entries(observers)
            self._observers = [each for each in observers if each.entries]
            self._history = History(self._state(), robot.action_dim)
        except BaseException:
            self.simulation.close()
            raise

    @property
    def num_envs(self) -> int:
        """Number of environments, n."""
        return self.simulation.num_envs

    @property
    def segmentation_ids(self) -> dict[str, int]:
        """What the numbers in segmentations stand for; see `RobotTaskEnv`."""
        return segmentation_ids(self._build_scene)

    # ---- start, act, observe -----------------------------------------------------

    def reset(
        self,
        envs: Sequence[int] | None = None,
        state: Mapping[str, Any] | None = None,
    ) -> Observed:
        """Start episodes.

        Args:
            envs: in which environments, and in those that were never reset; None means
                in all.
            state: what `get_state` returned or some of its entries, to start from:
                tensors of shape (*batch_shape, ...).

        Returns:
            What all environments observe.

        Raises:
            ValueError: the state cannot be one.
            BulletError: the environment is closed, or another thread is in it.
        """
        with self._guard:
            self._check_open()
            chosen = range(self.num_envs) if envs is None else envs
            envs = sorted({*chosen, *self._never_reset})
            given = GivenState({})
            if state is not None:
                given = read_state(
                    state,
                    batch_shape=self.batch_shape,
                    like=self._state(),
                    envs=envs,
                    action_dim=self.robot.action_dim,
                )
                self._check_goal(given.values, envs)
            for env in envs:
                self._draw_start(env)
            tensors = self._state()
            for key, value in (given.start or given.values).items():
                tensors[key][envs] = value
            self._place(envs)
            if given.start:
                self._replay(envs, given)
            observed = self._observe()
            for key in ("terminated", "truncated", "done"):
                # A given state may be an episode's last; the next step ends it again.
                observed[key][envs] = False
            return observed

    def step(self, action: Tensor | None, stepped: Tensor | None = None) -> Observed:
        """Act for one step.

        Args:
            action: (*batch_shape, action_dim), floating point; it is clipped to
                [-1, 1].
            stepped: which environments take it, (n, 1) bool; None means all.

        Returns:
            What all environments observe, and ``reward``, (n, 1) float32.

        Raises:
            BulletError: the environment is closed, was never reset, has diverged, or
                another thread is in it.
            ValueError: the action has a wrong shape, or is not finite.
            TypeError: it is not of floating point.
        """
        with self._guard:
            self._check_was_reset()
            action = read_action(action, (*self.batch_shape, self.robot.action_dim))
            envs = None if stepped is None else indices(stepped)
            self._step_count += 1 if stepped is None else stepped
            self._history.append(action, stepped)
            self._act(action, envs)
            if diverged := self.simulation.diverged():
                self._recover(diverged)
            for reading in self._readings:
                reading.after_step(range(self.num_envs) if envs is None else envs)
            observed = self._observe()
            goals = observed["achieved_goal"], observed["desired_goal"]
            if self._hooks.reward is None:
                reward = self.task.compute_reward(*goals).float()
            else:
                reward = self._hooks.reward(action, *goals).float()
            observed["reward"] = reward if stepped is None else reward * stepped
            return observed

    def get_state(self, *, exact: bool = False) -> Observed:
        """The physical state; see `RobotTaskEnv.get_state`."""
        with self._guard:
            self._check_was_reset()
            state = {key: value.clone() for key, value in self._state().items()}
            return {**state, **self._history.export()} if exact else state

    def render(self, envs: Sequence[int], camera: Camera) -> Tensor:
        """Draw environments as they are: (len(envs), height, width, 3) uint8.

        Raises:
            BulletError: the environment is closed, or another thread is in it.
            ValueError: an index is out of range, or its environment was never reset.
            TypeError: an index is no integer.
        """
        with self._guard:
            self._check_open()
            for env in envs:
                known = integer("an index", env) in range(self.num_envs)
                if not known or env in self._never_reset:
                    raise ValueError(f"there is no environment {env} that was reset")
            return self._renderer.picture(envs, camera)

    def open_window(self, camera: Camera) -> Window:
        """Open pybullet's GUI; see `RobotTaskEnv.open_window`."""
        with self._guard:
            self._check_open()
            return Window(self.simulation, self._build_scene, camera)

    def open_viewer(self, camera: Camera, host: str, port: int) -> "WebViewer":
        """Serve the scene to browsers; see `RobotTaskEnv.open_viewer`."""
        if find_spec("viser") is None:
            raise ImportError("viewers need viser: pip install -e '.[viewer]'")
        from torch_panda.rendering.web_viewer import WebViewer

        with self._guard:
            self._check_open()
            return WebViewer(
                self.simulation,
                self._watched,
                max_episode_steps=self.max_episode_steps,
                title=type(self.task).__name__,
                camera=camera,
                host=host,
                port=port,
            )

    def close(self) -> None:
        """Free all clients and threads. Closing again does nothing."""
        with self._guard:
            if not self.is_closed:
                self.is_closed = True
                self._renderer.close()
                self.simulation.close()

    # ---- parts -------------------------------------------------------------------

    def _state(self) -> dict[str, Tensor]:
        """The tensors that hold the physical state, (n, ...); not copies."""
        simulation = self.simulation
        state = {
            "joint_position": simulation.joint_position,
            "joint_velocity": simulation.joint_velocity,
            "object_pose": simulation.object_pose,
            "object_velocity": simulation.object_velocity,
            "desired_goal": self._goal,
            "step_count": self._step_count,
            **self._variation.state,
        }
        if any(simulation.scene.object_joints):
            state["object_joint_position"] = simulation.object_joint_position
            state["object_joint_velocity"] = simulation.object_joint_velocity
        return state

    def _watched(self) -> Observed:
        """What a viewer says of the environments as they are, (n, ...)."""
        self._check_was_reset()
        achieved_goal = self.task.achieved_goal(self.simulation).float()
        desired_goal = self._goal.float()
        return {
            "step_count": self._step_count,
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": self.task.is_success(achieved_goal, desired_goal),
        }

    def _draw_start(self, env: int) -> None:
        """Put the start of an environment's next episode into the state tensors."""
        self._never_reset.discard(env)
        self._step_count[env] = 0
        rng = self.seeds.next_generator(env)
        draw_start(env, rng, self.robot, self.task, self.simulation, self._goal)
        if self._variation.is_on:
            self._variation.draw(env, self.seeds.physics_seed(env))

    def _place(self, envs: list[int]) -> None:
        """Put robots, objects and markers where the state tensors say."""
        simulation = self.simulation
        if simulation.scene.markers:
            pose = self.task.marker_pose(self._goal[envs])
            check_rotations("desired_goal", pose, envs)
            simulation.marker_pose[envs] = pose
        self._history.begin(envs, self._state())
        varies = self._variation.changes_physics
        simulation.reset(envs, self._variation.apply if varies else None)
        for reading in self._readings:
            reading.after_reset(envs)

    def _act(self, action: Tensor, envs: Sequence[int] | None) -> None:
        """Advance physics by a step."""
        setpoint = self.robot.setpoint(action, self.simulation).numpy()
        self.simulation.step(self._control, setpoint, envs)

    def _replay(self, envs: list[int], given: GivenState) -> None:
        """Take the actions of an exact state, and make sure that they lead there."""
        for action, acting, last in given.steps(envs, self.num_envs):
            stepped = torch.zeros(self.num_envs, 1, dtype=torch.bool, device="cpu")
            stepped[acting] = True
            self._history.append(action, stepped)
            self._act(action, acting)
            for reading in self._readings:
                reading.after_step(last)
        self._step_count[envs] = given.values["step_count"]
        given.check_arrival(envs, self._state())

    def _recover(self, envs: list[int]) -> None:
        """Start the next episode of environments whose physics has diverged."""
        for env in envs:
            self.simulation.rebuild(env)
            self._draw_start(env)
        self._place(envs)
        if self.on_divergence == "raise":
            raise BulletError(
                f"the physics of environments {envs} diverged: their state was not "
                f"finite; they are at the start of their next episode"
            )
        self._step_count[envs] = self.max_episode_steps

    def _observe(self) -> Observed:
        """Observation, goals, success and ends, (n, ...), in new tensors."""
        simulation, task = self.simulation, self.task
        observation = torch.cat(
            (self.robot.observation(simulation), task.observation(simulation)), dim=1
        )
        achieved_goal = task.achieved_goal(simulation).float()
        desired_goal = self._goal.float()
        success = task.is_success(achieved_goal, desired_goal)
        truncated = self._step_count >= self.max_episode_steps
        terminated = torch.zeros_like(success)
        if self.terminate_on_success:
            terminated = success & (self._step_count > 0)
        if self._hooks.failure is not None:
            terminated = terminated | self._hooks.failure() & (self._step_count > 0)
        observed: Observed = {}
        for observer in self._observers:
            observed |= observer.observe()
        return {
            **observed,
            "observation": observation.float(),
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": success,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }

    # ---- checks ------------------------------------------------------------------

    def _check_goal(self, given: Mapping[str, Tensor], envs: list[int]) -> None:
        """Make sure that a given goal, (k, goal_dim), is one that markers can show."""
        if self.simulation.scene.markers and "desired_goal" in given:
            pose = self.task.marker_pose(given["desired_goal"])
            check_rotations("desired_goal", pose, envs)

    def _check_open(self) -> None:
        if self.is_closed:
            raise BulletError("the environment is closed")

    def _check_was_reset(self) -> None:
        self._check_open()
        if self._never_reset:
            raise BulletError(
                f"environments {sorted(self._never_reset)} were never reset: call "
                f"reset first"
            )


def indices(mask: Tensor) -> list[int]:
    """Where a mask, (n, 1) or (n,), is true."""
    return mask.flatten().nonzero().flatten().tolist()
