"""Runs episodes of a robot and a task in plain torch, without torchrl."""

import math
import secrets
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet import (
    BulletError,
    PhysicsClient,
    PhysicsName,
    PhysicsParams,
    Scene,
    VectorSimulation,
    resolve_physics,
)
from torch_panda.bullet.body_state import Doubles
from torch_panda.checks import (
    QUATERNION_TOLERANCE,
    all_finite,
    check_choice,
    check_instance,
    check_integer,
    check_positive,
    check_rotations,
    check_seed,
)
from torch_panda.envs.exact_states import ExactStates, Replay
from torch_panda.envs.goal_observation import GoalName, GoalObserver, find_goal_indices
from torch_panda.envs.randomization import (
    PHYSICS_KEYS,
    DomainRandomizer,
    Randomization,
)
from torch_panda.envs.state import BODY_KEYS, EXACT_KEYS, read_state
from torch_panda.envs.task_problems import find_problems, find_uncalled_samplers
from torch_panda.rendering import RendererName, VectorRenderer, check_renderer
from torch_panda.robots import Robot
from torch_panda.sensors import (
    Entry,
    JointState,
    Observer,
    Sensor,
    join_entries,
    resolve_sensors,
)
from torch_panda.tasks import Bodies, Task

OnDivergence = Literal["raise", "reset"]

Observed = dict[str, Tensor]
"""Observed entries of all environments, (n, ...) by key, in new tensors."""

# Keys that Gymnasium and Stable-Baselines3 write into infos.
_GYMNASIUM_INFO_KEYS = {
    "is_success", "final_obs", "final_info", "terminal_observation", "episode",
    "TimeLimit.truncated",
}  # fmt: skip


class Episodes:
    """Runs the episodes of n environments of one robot and one task.

    It owns the number, the step count, the goal and the start of every episode.
    `RobotTaskEnv` explains the arguments.

    All tensors are on the CPU and have n rows. Only actions and states that a caller
    passes have the batch shape of a `RobotTaskEnv`: (n,), or () if ``num_envs`` is None
    (then n is 1).

    A call raises `BulletError` while a call of another thread is running.

    Attributes:
        simulation: The Bullet clients and their state.
        renderer: Renders the environments.
        goal: Desired goals of the running episodes, (n, task.goal_dim) float64.
        step_count: Number of steps of the running episodes, (n, 1) int64.
        seed: The seed of the constructor or of the last `set_seed`; None means that it
            was drawn from the operating system.
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
        _raise_problems(find_uncalled_samplers(task))
        self.goal_indices = find_goal_indices(robot, task)
        if goal == "observation" and self.goal_indices is None:
            raise ValueError(
                f'goal="observation" needs a task that declares where the observation '
                f"holds the achieved goal, but {type(task).__name__} has no "
                "goal_entries, or overrides observation or achieved_goal without "
                'declaring them again; set Task.goal_entries, or use goal="task"'
            )
        self.robot, self.task = robot, task
        self.max_episode_steps = max_episode_steps or task.max_episode_steps
        self.terminate_on_success = terminate_on_success
        self.on_divergence = on_divergence
        self.physics = resolve_physics(physics)
        self._control = robot.controller
        # Optional hooks of the task are called only if it overrides them.
        self._has_reward = type(task).reward is not Task.reward
        self._has_failure = type(task).failure is not Task.failure
        n = num_envs or 1
        self.batch_shape = () if num_envs is None else (n,)
        self.is_closed = False
        self._guard = ThreadGuard()
        # Environments that need a reset: new ones, and those whose last reset failed.
        self._needs_reset = set(range(n))
        self.seed = seed
        self._streams: list[tuple[int, int]] = []  # (seed, index) by environment
        self._episode_numbers = [0] * n  # of the next episodes
        self.set_seed(seed)
        sensors = resolve_sensors(sensors, robot)
        # With a bound method, the simulation would refer back to this object, and the
        # cycle of references would keep a forgotten environment alive.
        build = partial(_build_scene, robot, task, sensors)
        self.simulation = simulation = VectorSimulation(
            build, n, num_threads=num_threads, physics=self.physics
        )
        try:
            _raise_problems(find_problems(robot, task, simulation, self.goal_indices))
            self.renderer = VectorRenderer(simulation, renderer=renderer)
            self._randomizer = DomainRandomizer(randomize, robot, task, simulation)
            self.goal = torch.zeros(n, task.goal_dim, dtype=torch.float64, device="cpu")
            self.step_count = torch.zeros(n, 1, dtype=torch.int64, device="cpu")
            self.goal_dim = task.goal_dim
            self._goal_observer: GoalObserver | None = None
            if goal == "observation" and self.goal_indices is not None:
                self.goal_dim = robot.observation_dim + task.observation_dim
                self._goal_observer = GoalObserver(
                    robot, task, simulation, build, self.physics, self.goal_indices
                )
            self._add_observers(sensors)
            self._exact_states = ExactStates(self._state(), robot.action_dim)
            # From now on, changes of most arguments would have no effect.
            robot.freeze()
            task.freeze()
        except BaseException:
            simulation.close()
            raise

    def _add_observers(self, sensors: Sequence[Sensor]) -> None:
        """Find the entries that sensors, hooks and randomization add to the outputs."""
        task, simulation = self.task, self.simulation
        # Sensors also follow resets and steps; the other observers only observe.
        self._sensors = [
            sensor.attach(simulation, self.renderer, self.robot) for sensor in sensors
        ]
        info = HookObserver(task, simulation, "info")
        extra = HookObserver(task, simulation, "extra_observation")
        self.info_keys = frozenset(info.entries)
        if taken := self.info_keys & _GYMNASIUM_INFO_KEYS:
            raise ValueError(
                f"{type(task).__name__}.info must not return {sorted(taken)}, because "
                f"Gymnasium and Stable-Baselines3 use these keys"
            )
        # Keys of states, which sensors and tasks may not observe. Only the sensor
        # "joint_state" may use two of them; see `is_state`.
        reserved = {*BODY_KEYS, *PHYSICS_KEYS, *EXACT_KEYS}
        if any(isinstance(sensor, JointState) for sensor in sensors):
            reserved -= {"joint_position", "joint_velocity"}
        observers: list[Observer] = [*self._sensors, extra, info]
        # The randomizer may observe a reserved key, so add its entries after the check
        # of `join_entries`.
        self.entries = join_entries(observers, reserved) | self._randomizer.entries
        observers.append(self._randomizer)
        self._observers = [observer for observer in observers if observer.entries]

    @property
    def num_envs(self) -> int:
        """Number of environments, n."""
        return len(self._episode_numbers)

    # ---- seeds -------------------------------------------------------------------

    def set_seed(self, seed: int | None) -> None:
        """Restart the sequence of episodes of all environments.

        Raises:
            ValueError: The seed is negative.
            TypeError: The seed is not an integer.
        """
        number = secrets.randbits(63) if seed is None else check_seed(seed)
        self.seed = None if seed is None else number
        self._streams = [(number, env) for env in range(self.num_envs)]
        self._episode_numbers = [0] * self.num_envs

    def set_env_seed(self, env: int, seed: int) -> None:
        """Seed one environment; see `RobotTaskEnv.set_env_seed`."""
        if not 0 <= env < self.num_envs:
            raise ValueError(f"env must be from 0 to {self.num_envs - 1}, got {env}")
        self._streams[env] = (check_seed(seed), 0)
        self._episode_numbers[env] = 0

    def seed_state(self) -> dict[str, Any]:
        """Seeds and episode numbers, as plain numbers for `load_seed_state`."""
        return {
            "seed": self.seed,
            "streams": [list(stream) for stream in self._streams],
            "episodes": list(self._episode_numbers),
        }

    def load_seed_state(self, state: Mapping[str, Any]) -> None:
        """Continue with the seeds and episode numbers that `seed_state` returned.

        Raises:
            ValueError: The state belongs to a different number of environments.
        """
        streams, numbers = state["streams"], state["episodes"]
        if len(numbers) != self.num_envs:
            raise ValueError(
                f"the state_dict holds {len(numbers)} environments, but this one has "
                f"{self.num_envs}: make it with num_envs={len(numbers)}"
            )
        self.seed = state["seed"]
        self._streams = [(seed, index) for seed, index in streams]
        self._episode_numbers = list(numbers)

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
            values, replay = self._read_state(state, envs)
            # If anything below raises, these environments need another reset.
            self._needs_reset.update(envs)
            # A step that raised `WorkerError` did not rebuild the diverged clients.
            for env in set(envs).intersection(self.simulation.diverged()):
                self.simulation.rebuild(env)
            self._start_episodes(envs, values if replay is None else replay.start)
            if replay is not None:
                replay.run(self._repeat_step, self._state())
            self._needs_reset.difference_update(envs)
            observed = self._observe()
            if state is not None:
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
            action = self._read_action(action)
            envs = None if step_mask is None else indices(step_mask)
            # If the robot's function raises, no step was taken.
            setpoint = self._setpoint(action)
            self.step_count += 1 if step_mask is None else step_mask
            self._exact_states.record(action, step_mask, self.robot.action_scale)
            continued = range(self.num_envs) if envs is None else envs
            if diverged := self.simulation.step(self._control, setpoint, envs):
                continued = [env for env in continued if env not in diverged]
                ended = [goal[diverged] for goal in self._goals]
                self._recover(diverged)
                started = [goal[diverged] for goal in self._goals]
                # The observations show the next episodes, but with the goals of the
                # ended ones, which the policy pursued.
                self._set_goals(diverged, ended)
            for sensor in self._sensors:
                sensor.after_step(continued)
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
            state = {key: value.clone() for key, value in self._state().items()}
            if exact:
                state |= self._exact_states.export(self.robot.action_scale)
            return state

    def state_entries(self) -> dict[str, Entry]:
        """Shapes and dtypes of the entries of a state, by key."""
        return {
            key: Entry(tuple(value.shape[1:]), value.dtype)
            for key, value in self._state().items()
        }

    def progress(self) -> Observed:
        """Goals, success and number of steps, (n, ...), for a viewer.

        Raises:
            BulletError: The environment is closed or needs a reset.
        """
        self._check_all_reset()
        achieved_goal = self.task.achieved_goal(self.simulation).float()
        desired_goal = self.goal.float()
        return {
            "step_count": self.step_count,
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

    # ---- parts of a reset ----------------------------------------------------------

    def _state(self) -> dict[str, Tensor]:
        """The tensors of the state, (n, ...) by key, not copied."""
        simulation = self.simulation
        state = {
            "joint_position": simulation.joint_position,
            "joint_velocity": simulation.joint_velocity,
            "object_pose": simulation.object_pose,
            "object_velocity": simulation.object_velocity,
            "desired_goal": self.goal,
            "step_count": self.step_count,
            **self._randomizer.state,
        }
        if any(simulation.scene.object_joints):
            state["object_joint_position"] = simulation.object_joint_position
            state["object_joint_velocity"] = simulation.object_joint_velocity
        return state

    def _read_state(
        self, state: Mapping[str, Any] | None, envs: list[int]
    ) -> tuple[dict[str, Tensor], Replay | None]:
        """Check a state to start from, without changing the environments.

        Returns:
            The entries of the environments, (len(envs), ...) by key; and the actions to
            repeat, if the state is exact.
        """
        if state is None:
            return {}, None
        values = read_state(
            state, batch_shape=self.batch_shape, present=self._state(), envs=envs
        )
        replay = self._exact_states.read(state, values, envs, self.batch_shape)
        self._randomizer.check_state(values, envs)
        if replay is not None:
            self._randomizer.check_state(replay.start, envs)
        if self.simulation.scene.markers and "desired_goal" in values:
            # Raises if the task computes an invalid pose, before anything changes.
            self._marker_pose(values["desired_goal"], envs)
        return values, replay

    def _start_episodes(self, envs: list[int], values: Mapping[str, Tensor]) -> None:
        """Start the next episodes of some environments.

        Args:
            envs: The environments.
            values: Entries of the state that replace the drawn ones, (len(envs), ...).
        """
        state = self._state()
        arrays = {key: value.numpy() for key, value in state.items()}
        for env in envs:
            self._sample_start(env, {key: array[env] for key, array in arrays.items()})
        for key, value in values.items():
            state[key][envs] = value
        if self.simulation.scene.markers:
            pose = self._marker_pose(self.goal[envs], envs)
            self.simulation.marker_pose[envs] = pose
        self._exact_states.begin(envs)
        if self._goal_observer is not None:
            self._goal_observer.update(envs, self.goal)
        randomizer = self._randomizer
        randomize = randomizer.apply if randomizer.changes_physics else None
        self.simulation.reset(envs, randomize)
        for sensor in self._sensors:
            sensor.after_reset(envs)

    def _sample_start(self, env: int, row: dict[str, Doubles]) -> None:
        """Draw the start of an environment's next episode into its row of the state.

        The robot starts in its neutral pose. The task draws the goal, the objects and
        their joints. The randomizer draws the physics, and offsets of the robot's
        joints.

        Raises:
            ValueError: The task draws numbers of a wrong shape, numbers that are not
                finite, or quaternions that are not unit quaternions.
        """
        episode = (*self._streams[env], self._episode_numbers[env])
        self._episode_numbers[env] += 1
        start = self.task.sample_start(np.random.default_rng(episode))
        row["step_count"][:] = 0
        self._fill(row["desired_goal"], start.goal, "sample_goal")
        row["joint_position"][:] = self.robot.neutral_joint_position
        row["joint_velocity"][:] = 0.0
        if len(row["object_pose"]):
            self._fill(row["object_pose"], start.object_pose, "sample_objects")
            for *_, x, y, z, w in row["object_pose"].tolist():
                if abs(math.hypot(x, y, z, w) - 1) > QUATERNION_TOLERANCE:
                    raise ValueError(
                        f"{self._sampler('sample_objects')} must return unit "
                        f"quaternions, got {[x, y, z, w]}"
                    )
            row["object_velocity"][:] = 0.0
        if "object_joint_position" in row:
            joints = row["object_joint_position"]
            drawn = np.asarray(start.object_joint_position)
            # A single number is the position of every joint.
            drawn = np.broadcast_to(drawn, joints.shape) if drawn.size == 1 else drawn
            self._fill(joints, drawn, "sample_object_joints")
            row["object_joint_velocity"][:] = 0.0
        if self._randomizer.is_active:
            # Another stream of the same episode, so that randomized physics do not
            # change the drawn goals and objects.
            seed = np.random.SeedSequence(episode, spawn_key=(1,))
            self._randomizer.sample(env, seed)

    def _fill(self, row: Doubles, values: object, sampler: str) -> None:
        """Check the numbers that the task drew and write them into the state."""
        drawn = np.asarray(values, dtype=np.float64)
        if drawn.shape != row.shape or not np.isfinite(drawn).all():
            raise ValueError(
                f"{self._sampler(sampler)} must return finite numbers of shape "
                f"{row.shape}, got {values}"
            )
        row[:] = drawn

    def _sampler(self, name: str) -> str:
        """``sample_start`` if the task overrides it, otherwise ``name``; for errors."""
        overrides = type(self.task).sample_start is not Task.sample_start
        return "sample_start" if overrides else name

    def _marker_pose(self, goal: Tensor, envs: list[int]) -> Tensor:
        """Poses of the markers for goals of some environments, (len(envs), n, 7)."""
        pose = self.task.marker_pose(goal)
        if type(self.task).marker_pose is not Task.marker_pose:
            check_rotations("the marker pose for the desired_goal", pose, envs)
        return pose

    def _repeat_step(self, action: Tensor, step_mask: Tensor, last: list[int]) -> None:
        """Repeat a step of an exact state; see `exact_states.TakeStep`."""
        self._exact_states.record(action, step_mask, self.robot.action_scale)
        setpoint = self._setpoint(action)
        self.simulation.step(self._control, setpoint, indices(step_mask))
        # Sensors report the present only, so the last step of each environment is
        # enough for them.
        for sensor in self._sensors:
            sensor.after_step(last)

    # ---- parts of a step -----------------------------------------------------------

    def _read_action(self, action: Tensor | None) -> Tensor:
        """Check an action; return a clipped copy, (n, action_dim) float32."""
        shape = (*self.batch_shape, self.robot.action_dim)
        if not isinstance(action, Tensor):
            raise ValueError(
                f"the action must be a tensor of shape {shape}, got {action!r}"
            )
        if action.shape != shape:
            raise ValueError(
                f"the action must have shape {shape}, got {tuple(action.shape)}"
            )
        if not action.dtype.is_floating_point:
            raise TypeError(
                f"the action must have a floating-point dtype, got {action.dtype}: "
                f"pass action.float()"
            )
        action = action.detach().cpu().view(-1, shape[-1])
        if not all_finite(action):
            env = int((~action.isfinite()).any(dim=1).nonzero()[0])
            raise ValueError(
                f"the action of environment {env} is not finite: {action[env].tolist()}"
            )
        return action.clamp(-1.0, 1.0).float()

    def _setpoint(self, action: Tensor) -> Doubles:
        """Compute the setpoints of the motors, (n, ...); see `Robot.setpoint`."""
        return self.robot.setpoint(action, self.simulation).numpy()

    def _observe(self, action: Tensor | None = None) -> Observed:
        """Observe all environments.

        Args:
            action: The action that led to the present state, (n, action_dim); None
                after a reset.

        Returns:
            ``observation``, the goals, ``success``, ``terminated``, ``truncated``,
            ``done``, and the keys of `entries`; after a step also ``reward``.
        """
        robot, task, simulation = self.robot, self.task, self.simulation
        parts = robot.observation(simulation), task.observation(simulation)
        observation = torch.cat(parts, dim=1).float()
        # A copy, because a task may return a tensor that the next step overwrites.
        achieved_goal = task.achieved_goal(simulation).to(torch.float32, copy=True)
        desired_goal = self.goal.float()
        reward = None
        if action is None or self._has_reward:
            success = task.is_success(achieved_goal, desired_goal)
        else:
            success, reward = task.judge(achieved_goal, desired_goal)
        terminated = success if self.terminate_on_success else torch.zeros_like(success)
        if self._has_failure:
            terminated = terminated | task.failure(simulation)
        if self._has_failure or self.terminate_on_success:
            # No episode ends before its first step.
            terminated = terminated & (self.step_count > 0)
        truncated = self.step_count >= self.max_episode_steps
        observed = {
            "observation": observation,
            "achieved_goal": achieved_goal,
            "desired_goal": desired_goal,
            "success": success,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        if reward is not None:
            observed["reward"] = reward.float()
        elif action is not None:
            reward = task.reward(
                simulation, action.clone(), achieved_goal, desired_goal
            )
            observed["reward"] = reward.to(torch.float32, copy=True)
        if self._goal_observer is not None:
            observed["achieved_goal"] = observation.clone()
            observed["desired_goal"] = self._goal_observer.desired.clone()
        for observer in self._observers:
            observed |= observer.observe()
        return observed

    @property
    def _goals(self) -> list[Tensor]:
        """Desired goals, (n, ...): the task's, and the observations of them."""
        observer = self._goal_observer
        return [self.goal] + ([] if observer is None else [observer.desired])

    def _set_goals(self, envs: list[int], values: list[Tensor]) -> None:
        """Set the rows of `_goals` that belong to some environments."""
        for goal, rows in zip(self._goals, values, strict=True):
            goal[envs] = rows

    def _recover(self, envs: list[int]) -> None:
        """Start the next episode of environments whose physics diverged."""
        # If anything below raises, these environments need a reset.
        self._needs_reset.update(envs)
        for env in envs:
            self.simulation.rebuild(env)
        self._start_episodes(envs, {})
        self._needs_reset.difference_update(envs)
        if self.on_divergence == "raise":
            raise BulletError(
                f"the physics of environments {envs} diverged: their state was not "
                f"finite; they are at the start of their next episode"
            )
        # Makes ``truncated`` true, so that torchrl resets these environments.
        self.step_count[envs] = self.max_episode_steps

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


class ThreadGuard:
    """A context manager that one thread at a time may enter.

    Two threads in one Bullet client crash the interpreter. The thread that is inside
    may enter again.

    Raises:
        BulletError: Another thread is inside.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise BulletError(
                "another thread is using this environment: it serves one thread at a "
                "time, so make an environment for each thread"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class HookObserver:
    """Observes the entries of `Task.extra_observation` or `Task.info`.

    Args:
        task: The task.
        simulation: The environments.
        name: Name of the hook.

    Attributes:
        entries: The entries, by key; empty if the task does not override the hook.
    """

    def __init__(self, task: Task, simulation: VectorSimulation, name: str) -> None:
        self._hook = getattr(task, name)
        self._simulation = simulation
        self.entries: dict[str, Entry] = {}
        if getattr(type(task), name) is not getattr(Task, name):
            for key, value in self.observe().items():
                self.entries[key] = Entry(tuple(value.shape[1:]), value.dtype)

    def observe(self) -> Observed:
        """The entries of all environments, (n, ...), in new tensors."""
        return {
            key: value.float() if value.dtype == torch.float64 else value.clone()
            for key, value in self._hook(self._simulation).items()
        }


def _build_scene(
    robot: Robot, task: Task, sensors: Sequence[Sensor], client: PhysicsClient
) -> Scene:
    """Build the scene in a client. It is the same scene in every client.

    Raises:
        TypeError: `Robot.build` does not return a body id, or `Task.build` does not
            return `Bodies`.
        ValueError: `Bodies` does not hold tuples of body ids, or a joint has several
            degrees of freedom.
    """
    body = robot.build(client)
    if not isinstance(body, int):
        raise TypeError(
            f"{type(robot).__name__}.build must return the robot's body id, "
            f"got {body!r}"
        )
    bodies = task.build(client)
    if not isinstance(bodies, Bodies):
        raise TypeError(
            f"{type(task).__name__}.build must return Bodies, got {bodies!r}"
        )
    for name, ids in bodies._asdict().items():
        if not (isinstance(ids, Collection) and {*ids} <= {*client.bodies}):
            raise ValueError(
                f"{name} of the Bodies that {type(task).__name__}.build returns must "
                f"be a tuple of ids from {client.bodies}, got {ids!r}"
            )
    for sensor in sensors:
        sensor.build(client, body, robot)
    objects = tuple(bodies.objects)
    return Scene(
        robot=body,
        joints=_movable_joints(client, body),
        ee_link=robot.ee_link,
        objects=objects,
        object_joints=tuple(_movable_joints(client, k) for k in objects),
        markers=tuple(bodies.markers),
    )


def _movable_joints(client: PhysicsClient, body: int) -> tuple[int, ...]:
    joints = client.joints(body)
    for joint in joints:
        if joint.num_dofs > 1:
            raise ValueError(
                f"joint {joint.name!r} of body {body} must have at most one degree of "
                f"freedom, got {joint.num_dofs}"
            )
    return tuple(joint.number for joint in joints if joint.is_movable)


def _raise_problems(problems: Sequence[str]) -> None:
    if problems:
        raise ValueError("\n".join(problems))


def indices(mask: Tensor) -> list[int]:
    """Indices at which a mask, (n, 1) or (n,), is true."""
    return mask.flatten().nonzero().flatten().tolist()
