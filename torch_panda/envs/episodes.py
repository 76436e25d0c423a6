"""Runs episodes of a robot and a task in plain torch, without torchrl."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
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
from torch_panda.checks import (
    check_action,
    check_choice,
    check_instance,
    check_integer,
    check_positive,
)
from torch_panda.envs.builder import build_scene
from torch_panda.envs.goal_observation import GoalName, GoalObserver, find_goal_indices
from torch_panda.envs.history import History
from torch_panda.envs.observer import EpisodeObserver, Observed
from torch_panda.envs.randomization import DomainRandomizer, Randomization
from torch_panda.envs.seeds import EpisodeSeeds
from torch_panda.envs.start import EpisodeStarts, check_samplers
from torch_panda.envs.state import StartState, read_state
from torch_panda.rendering import RendererName, VectorRenderer, check_renderer
from torch_panda.robots import Robot
from torch_panda.sensors import Entry, Sensor, read_sensors
from torch_panda.tasks import Task

OnDivergence = Literal["raise", "reset"]


class Episodes:
    """Runs the episodes of n environments of one robot and one task.

    `RobotTaskEnv` explains the arguments.

    All tensors are on the CPU and have n rows. Only actions and states that a caller
    passes have the batch shape of a `RobotTaskEnv`: (n,), or () if ``num_envs`` is None
    (then n is 1).

    A call raises `BulletError` while a call of another thread is running.

    Attributes:
        simulation: The Bullet clients and their state.
        renderer: Draws the environments.
        seeds: Seeds of the episodes.
        entries: Shape and dtype of the keys that sensors, task and randomization add to
            the outputs.
        info_keys: Keys among them that `Task.info` adds. They are no observations.
        goal_indices: Column of ``observation`` of each number of the task's achieved
            goal, or None; see `RobotTaskEnv.goal_indices`.
        goal_dim: Size of ``achieved_goal`` and ``desired_goal``.
    """

    # Leave inference mode, because tensors made in this mode cannot be changed outside
    # it.
    @torch.inference_mode(False)
    def __init__(
        self,
        *,
        robot: Robot,
        task: Task,
        num_envs: int | None,
        num_threads: int | None,
        seed: int | None,
        max_episode_steps: int | None,
        terminate_on_success: bool,
        physics: PhysicsParams | PhysicsName,
        sensors: Sequence[Sensor | str],
        renderer: RendererName,
        on_divergence: OnDivergence,
        randomize: Randomization | None,
        goal: GoalName,
    ) -> None:
        check_instance("robot", robot, Robot)
        check_instance("task", task, Task)
        check_samplers(task)
        if randomize is not None:
            check_instance("randomize", randomize, Randomization)
        check_positive(
            num_envs=num_envs,
            num_threads=num_threads,
            max_episode_steps=max_episode_steps,
        )
        check_renderer(renderer)
        check_choice("on_divergence", on_divergence, get_args(OnDivergence))
        check_choice("goal", goal, get_args(GoalName))
        n = num_envs or 1
        self.goal_indices = find_goal_indices(robot, task)
        if goal == "observation" and self.goal_indices is None:
            raise ValueError(
                f'goal="observation" needs a task that declares where the observation '
                f"holds the achieved goal, but {type(task).__name__} has no "
                "goal_entries, or overrides observation or achieved_goal without "
                'declaring them again; set Task.goal_entries, or use goal="task"'
            )
        self.robot, self.task = robot, task
        self._control = robot.controller
        self.batch_shape = () if num_envs is None else (n,)
        self._action_shape = (*self.batch_shape, robot.action_dim)
        self.max_episode_steps = max_episode_steps or task.max_episode_steps
        self.on_divergence = on_divergence
        self.physics = read_physics(physics)
        self.seeds = EpisodeSeeds(n, seed)
        self.is_closed = False
        self._guard = ThreadGuard()
        # Environments that need a reset: new ones, and those whose last reset failed.
        self._needs_reset = set(range(n))
        sensors = read_sensors(sensors, robot)
        # With a bound method, the simulation would refer back to this object, and the
        # cycle of references would keep a forgotten environment alive.
        build = partial(build_scene, robot, task, sensors)
        self.simulation = VectorSimulation(
            build, n, num_threads=num_threads, physics=self.physics
        )
        try:
            self.renderer = VectorRenderer(self.simulation, renderer=renderer)
            randomizer = DomainRandomizer(
                randomize, robot, task, self.simulation, self.physics
            )
            self.goal_dim = task.goal_dim
            self._goal_observer: GoalObserver | None = None
            if goal == "observation" and self.goal_indices is not None:
                self.goal_dim = robot.observation_dim + task.observation_dim
                self._goal_observer = GoalObserver(
                    robot, task, self.simulation, build, self.physics, self.goal_indices
                )
            self._observer = EpisodeObserver(
                robot,
                task,
                self.simulation,
                self.renderer,
                sensors=sensors,
                randomizer=randomizer,
                goal_indices=self.goal_indices,
                max_episode_steps=self.max_episode_steps,
                terminate_on_success=terminate_on_success,
            )
            self.entries = self._observer.entries
            self.info_keys = self._observer.info_keys
            self._randomizer = randomizer
            # Draws the starts of episodes, and holds the goals, the step counts and the
            # state tensors of the running episodes.
            self._starts = EpisodeStarts(
                robot, task, self.simulation, randomizer, self.seeds
            )
            self._history = History(self._starts.state(), robot.action_dim)
            # From now on, changes of most arguments would have no effect.
            robot.freeze()
            task.freeze()
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
            envs: Environments that start an episode; None means all. Environments that
                were never reset, or whose last reset failed, are always included.
            state: The state to start from: tensors of shape (*batch_shape, ...), all or
                some of the entries that `RobotTaskEnv.get_state` returns.

        Returns:
            The observed entries of all environments.

        Raises:
            ValueError: The state is wrong.
            BulletError: The environment is closed, or another thread is using it.
            WorkerError: Bullet failed in at least one environment.
        """
        with self._guard:
            self._check_open()
            chosen = range(self.num_envs) if envs is None else envs
            envs = sorted({*chosen, *self._needs_reset})
            start_state = None if state is None else self._read_state(state, envs)
            # If anything below raises, these environments need another reset.
            self._needs_reset.update(envs)
            # A step that raised `WorkerError` did not rebuild the diverged clients.
            for env in set(envs).intersection(self.simulation.diverged()):
                self.simulation.rebuild(env)
            for env in envs:
                self._starts.draw(env)
            if start_state is not None:
                tensors = self._starts.state()
                for key, value in (start_state.origin or start_state.values).items():
                    tensors[key][envs] = value
            self._start_episodes(envs)
            if start_state is not None and start_state.origin:
                self._repeat_actions(envs, start_state)
            self._needs_reset.difference_update(envs)
            observed = self._observe()
            if start_state is not None:
                # An episode that has just started is not done, even if the given state
                # was the last of an episode.
                for key in ("terminated", "truncated", "done"):
                    observed[key][envs] = False
            return observed

    def step(self, action: Tensor | None, step_mask: Tensor | None = None) -> Observed:
        """Act for one step.

        Args:
            action: (*batch_shape, action_dim), floating point. It is clipped to
                [-1, 1].
            step_mask: Mask of the environments that take the step, (n, 1) bool; None
                means all.

        Returns:
            The observed entries of all environments, and ``reward``, (n, 1) float32.

        Raises:
            BulletError: The environment is closed or needs a reset; another thread is
                using it; or the step diverges and ``on_divergence`` is "raise".
            WorkerError: Bullet failed in at least one environment.
            ValueError: The action has a wrong shape or is not finite.
            TypeError: The action has an integer dtype.
        """
        with self._guard:
            self._check_all_reset()
            action = self._begin_step(action, step_mask)
            envs = None if step_mask is None else indices(step_mask)
            self._history.record(action, step_mask)
            if diverged := self._advance(action, envs):
                ended = [goal[diverged] for goal in self._goals]
                self._recover(diverged)
                started = [goal[diverged] for goal in self._goals]
                # The observations show the next episodes, but with the goals of the
                # ended ones, which the policy pursued.
                self._set_goals(diverged, ended)
            self._observer.after_step(range(self.num_envs) if envs is None else envs)
            observed = self._observe(action)
            if step_mask is not None:
                observed["reward"] = observed["reward"] * step_mask
            if diverged:
                self._set_goals(diverged, started)
                # `observed` shows the start of these environments' next episodes. A
                # success there is not a success of this step.
                observed["success"][diverged] = observed["terminated"][diverged] = False
            return observed

    def get_state(self, *, exact: bool = False) -> Observed:
        """The physical state, (n, ...) by key; see `RobotTaskEnv.get_state`."""
        with self._guard:
            self._check_all_reset()
            state = {key: value.clone() for key, value in self._starts.state().items()}
            return {**state, **self._history.export()} if exact else state

    def state_entries(self) -> dict[str, Entry]:
        """Shapes and dtypes of the entries of a state, by key."""
        return {
            key: Entry(tuple(value.shape[1:]), value.dtype)
            for key, value in self._starts.state().items()
        }

    def progress(self) -> Observed:
        """Goals, success and number of steps, (n, ...), for a viewer.

        Raises:
            BulletError: The environment is closed or needs a reset.
        """
        self._check_all_reset()
        achieved_goal = self.task.achieved_goal(self.simulation).float()
        desired_goal = self._starts.goal.float()
        return {
            "step_count": self._starts.step_count,
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": self.task.is_success(achieved_goal, desired_goal),
        }

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Context manager in which calls of other threads raise an error.

        Raises:
            BulletError: The environment is closed, or another thread is using it.
        """
        with self._guard:
            self._check_open()
            yield

    def check_index(self, env: int) -> None:
        """Check that an environment exists and was reset, so that it can be rendered.

        Raises:
            ValueError: The index is out of range, or the environment needs a reset.
            TypeError: The index is not an integer.
        """
        if check_integer("an index", env) not in range(self.num_envs):
            raise ValueError(
                f"an index of an environment must be from 0 to {self.num_envs - 1}, "
                f"got {env}"
            )
        if env in self._needs_reset:
            raise ValueError(f"environment {env} was not reset: call reset first")

    def close(self) -> None:
        """Free all clients and threads. Closing again does nothing."""
        with self._guard:
            self.is_closed = True
            self.renderer.close()
            self.simulation.close()

    # ---- parts of a step and of a reset --------------------------------------------

    def _start_episodes(self, envs: list[int]) -> None:
        """Start the episodes whose starts are in the state tensors."""
        self._starts.place_markers(envs)
        self._history.begin(envs)
        if self._goal_observer is not None:
            self._goal_observer.update(envs, self._starts.goal)
        randomizer = self._randomizer
        randomize = randomizer.apply if randomizer.changes_physics else None
        self.simulation.reset(envs, randomize)
        self._observer.after_reset(envs)

    @property
    def _goals(self) -> list[Tensor]:
        """Desired goals, (n, ...): the task's, and the observations of them."""
        observer = self._goal_observer
        return [self._starts.goal] + ([] if observer is None else [observer.desired])

    def _set_goals(self, envs: list[int], values: list[Tensor]) -> None:
        """Set the rows of `_goals` that belong to some environments."""
        for goal, rows in zip(self._goals, values, strict=True):
            goal[envs] = rows

    def _observe(self, action: Tensor | None = None) -> Observed:
        starts = self._starts
        observed = self._observer.observe(starts.goal, starts.step_count, action)
        if self._goal_observer is not None:
            observed["achieved_goal"] = observed["observation"].clone()
            observed["desired_goal"] = self._goal_observer.desired.clone()
        return observed

    def _begin_step(self, action: Tensor | None, step_mask: Tensor | None) -> Tensor:
        """Check an action and count a step; return the clipped action, a new tensor."""
        action = check_action(action, self._action_shape)
        self._starts.step_count += 1 if step_mask is None else step_mask
        return action

    def _advance(self, action: Tensor, envs: Sequence[int] | None) -> list[int]:
        """Advance the physics by one step; return the environments that diverged."""
        setpoint = self.robot.setpoint(action, self.simulation).numpy()
        return self.simulation.step(self._control, setpoint, envs)

    def _read_state(self, state: Mapping[str, Any], envs: list[int]) -> StartState:
        """Check a state to start from, without changing the environments."""
        start_state = read_state(
            state,
            batch_shape=self.batch_shape,
            present=self._starts.state(),
            envs=envs,
            action_dim=self.robot.action_dim,
        )
        self._randomizer.check_state(start_state.values, envs)
        self._randomizer.check_state(start_state.origin, envs)
        if self.simulation.scene.markers and "desired_goal" in start_state.values:
            # Raises if the task computes an invalid pose, before anything changes.
            self._starts.marker_pose(start_state.values["desired_goal"], envs)
        return start_state

    def _repeat_actions(self, envs: list[int], start_state: StartState) -> None:
        """Repeat the actions of an exact state and check that they lead to it."""
        for action, acting, last in start_state.steps(envs, self.num_envs):
            step_mask = torch.zeros(self.num_envs, 1, dtype=torch.bool, device="cpu")
            step_mask[acting] = True
            self._history.record(action, step_mask)
            self._advance(action, acting)
            # Sensors report the present only, so the last step of each environment is
            # enough for them.
            self._observer.after_step(last)
        self._starts.step_count[envs] = start_state.values["step_count"]
        start_state.check_arrival(envs, self._starts.state())

    def _recover(self, envs: list[int]) -> None:
        """Start the next episode of environments whose physics diverged."""
        # If anything below raises, these environments need a reset.
        self._needs_reset.update(envs)
        for env in envs:
            self.simulation.rebuild(env)
            self._starts.draw(env)
        self._start_episodes(envs)
        self._needs_reset.difference_update(envs)
        if self.on_divergence == "raise":
            raise BulletError(
                f"the physics of environments {envs} diverged: their state was not "
                f"finite; they are at the start of their next episode"
            )
        # Makes ``truncated`` true, so that torchrl resets these environments.
        self._starts.step_count[envs] = self.max_episode_steps

    # ---- checks ------------------------------------------------------------------

    def _check_open(self) -> None:
        if self.is_closed:
            raise BulletError(
                "the environment is closed: make a new one (a Collector of torchrl "
                "closes its environment after its last batch)"
            )

    def _check_all_reset(self) -> None:
        self._check_open()
        if self._needs_reset:
            raise BulletError(
                f"environments {sorted(self._needs_reset)} were never reset, or their "
                f"last reset failed: call reset first"
            )


def indices(mask: Tensor) -> list[int]:
    """Indices at which a mask, (n, 1) or (n,), is true."""
    return mask.flatten().nonzero().flatten().tolist()
