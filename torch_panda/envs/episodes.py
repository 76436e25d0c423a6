"""Episodes of a robot at a task: start, act, observe. Plain torch, without torchrl."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, get_args

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
from torch_panda.envs.observer import EpisodeObserver, Observed
from torch_panda.envs.scene import TaskScene
from torch_panda.envs.seeds import EpisodeSeeds, integer
from torch_panda.envs.start import EpisodeStarts
from torch_panda.envs.state import GivenState, read_state
from torch_panda.envs.variation import Variation
from torch_panda.randomization import Randomization
from torch_panda.rendering import RendererName, VectorRenderer, check_renderer
from torch_panda.robots import Robot
from torch_panda.sensors import Sensor, read_sensors
from torch_panda.tasks import Task

OnDivergence = Literal["raise", "reset"]


class Episodes(Closing):
    """n environments of one robot and one task; see `RobotTaskEnv` for the arguments.

    Tensors are on the CPU and have n rows, also where ``num_envs`` is None: then n = 1,
    and only actions and states that are given have the batch shape ().

    A call while another thread is in it raises `BulletError`.

    Attributes:
        simulation: the clients and their state.
        build_scene: builds a scene as they hold it.
        renderer: draws them.
        seeds: of the episodes.
        entries: what is observed beyond state and goals, by key.
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
        goal = torch.zeros(n, task.goal_dim, dtype=torch.float64, device="cpu")
        sensors = read_sensors(sensors, robot)
        self.build_scene = TaskScene(robot, task, sensors)
        self.simulation = VectorSimulation(
            self.build_scene, n, num_threads=num_threads, physics=self.physics
        )
        try:
            check_functions(robot, task, self.simulation, goal)
            self.renderer = VectorRenderer(
                self.simulation, self.build_scene, renderer=renderer
            )
            hooks = TaskHooks(task, self.simulation, robot.action_dim)
            variation = Variation(
                randomize,
                robot,
                task,
                self.simulation,
                self.physics,
                has_hook=hooks.randomizes,
            )
            self._starts = EpisodeStarts(
                robot, task, self.simulation, variation, self.seeds, goal
            )
            self._observer = EpisodeObserver(
                robot,
                task,
                self.simulation,
                self.renderer,
                sensors=sensors,
                hooks=hooks,
                variation=variation,
                max_episode_steps=self.max_episode_steps,
                terminate_on_success=terminate_on_success,
            )
            self.entries = self._observer.entries
            self._history = History(self._starts.state(), robot.action_dim)
        except BaseException:
            self.simulation.close()
            raise

    @property
    def num_envs(self) -> int:
        """Number of environments, n."""
        return self.simulation.num_envs

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
                    like=self._starts.state(),
                    envs=envs,
                    action_dim=self.robot.action_dim,
                )
                self._starts.check_physics(given.values, envs)
                self._starts.check_physics(given.start, envs)
                if self.simulation.scene.markers and "desired_goal" in given.values:
                    self._starts.check_goal(given.values["desired_goal"], envs)
            # Until that is done: what fails leaves a world that is of no episode.
            self._never_reset.update(envs)
            # A step that failed elsewhere has told of no divergence.
            for env in set(envs).intersection(self.simulation.diverged()):
                self.simulation.rebuild(env)
            for env in envs:
                self._starts.draw(env)
            tensors = self._starts.state()
            for key, value in (given.start or given.values).items():
                tensors[key][envs] = value
            self._place(envs)
            if given.start:
                self._replay(envs, given)
            self._never_reset.difference_update(envs)
            observed = self._observe()
            if state is not None:
                # It may be an episode's last; the next step ends that again.
                for key in ("terminated", "truncated", "done"):
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
            self._starts.step_count += 1 if stepped is None else stepped
            self._history.append(action, stepped)
            if diverged := self._act(action, envs):
                self._recover(diverged)
            self._observer.after_step(range(self.num_envs) if envs is None else envs)
            observed = self._observe(action)
            if stepped is not None:
                observed["reward"] = observed["reward"] * stepped
            if diverged:  # what is observed there is the next episode's start
                observed["success"][diverged] = observed["terminated"][diverged] = False
            return observed

    def get_state(self, *, exact: bool = False) -> Observed:
        """The physical state; see `RobotTaskEnv.get_state`."""
        with self._guard:
            self._check_was_reset()
            state = {key: value.clone() for key, value in self._starts.state().items()}
            return {**state, **self._history.export()} if exact else state

    def watch(self) -> Observed:
        """What a viewer says of the environments as they are: goals and success.

        Raises:
            BulletError: the environment is closed or was never reset.
        """
        self._check_was_reset()
        return self._observer.watch(self._starts.goal, self._starts.step_count)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other threads out, as from `reset` and `step`.

        Raises:
            BulletError: the environment is closed, or another thread is in it.
        """
        with self._guard:
            self._check_open()
            yield

    def check_picture(self, env: int) -> None:
        """Make sure that there is an environment to be drawn.

        Raises:
            ValueError: an index is out of range, or its environment was never reset.
            TypeError: it is no integer.
        """
        known = integer("an index", env) in range(self.num_envs)
        if not known or env in self._never_reset:
            raise ValueError(f"there is no environment {env} that was reset")

    def close(self) -> None:
        """Free all clients and threads. Closing again does nothing."""
        with self._guard:
            if not self.is_closed:
                self.is_closed = True
                self.renderer.close()
                self.simulation.close()

    # ---- parts -------------------------------------------------------------------

    def _place(self, envs: list[int]) -> None:
        """Put environments where the state tensors say."""
        self._starts.mark(envs)
        self._history.begin(envs, self._starts.state())
        self._starts.place(envs)
        self._observer.after_reset(envs)

    def _observe(self, action: Tensor | None = None) -> Observed:
        starts = self._starts
        return self._observer.observe(starts.goal, starts.step_count, action)

    def _act(self, action: Tensor, envs: Sequence[int] | None) -> list[int]:
        """Advance physics by a step; return where it has diverged."""
        setpoint = self.robot.setpoint(action, self.simulation).numpy()
        return self.simulation.step(self._control, setpoint, envs)

    def _replay(self, envs: list[int], given: GivenState) -> None:
        """Take the actions of an exact state, and make sure that they lead there."""
        for action, acting, last in given.steps(envs, self.num_envs):
            stepped = torch.zeros(self.num_envs, 1, dtype=torch.bool, device="cpu")
            stepped[acting] = True
            self._history.append(action, stepped)
            self._act(action, acting)
            self._observer.after_step(last)
        self._starts.step_count[envs] = given.values["step_count"]
        given.check_arrival(envs, self._starts.state())

    def _recover(self, envs: list[int]) -> None:
        """Start the next episode of environments whose physics has diverged."""
        for env in envs:
            self.simulation.rebuild(env)
            self._starts.draw(env)
        self._place(envs)
        if self.on_divergence == "raise":
            raise BulletError(
                f"the physics of environments {envs} diverged: their state was not "
                f"finite; they are at the start of their next episode"
            )
        self._starts.step_count[envs] = self.max_episode_steps

    # ---- checks ------------------------------------------------------------------

    def _check_open(self) -> None:
        if self.is_closed:
            raise BulletError("the environment is closed")

    def _check_was_reset(self) -> None:
        self._check_open()
        if self._never_reset:
            raise BulletError(
                f"environments {sorted(self._never_reset)} were never reset, or their "
                f"last reset failed: call reset first"
            )


def indices(mask: Tensor) -> list[int]:
    """Where a mask, (n, 1) or (n,), is true."""
    return mask.flatten().nonzero().flatten().tolist()
