"""Many copies of one scene, stepped in parallel."""

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet.broad_phase import BroadPhase
from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.pool import Work, WorkerPool
from torch_panda.bullet.scene_client import Blueprint, SceneClient

# Sets the motors of an environment's robot, in the thread that steps its client.
Control = Callable[[PhysicsClient, int], None]

# Of a client's substeps. Of 0.3 and 0.5 the better, by the durations of Push.
_LAST_PIECE = 0.3


class _Pieces:
    """Work on one index in several pieces, each done by whichever thread comes next."""

    def __init__(self, *pieces: Work) -> None:
        self._pieces = list(pieces)
        self._lock = threading.Lock()

    def __call__(self, index: int) -> None:
        with self._lock:
            self._pieces[0](index)
            del self._pieces[0]  # only if it did not fail


@dataclass(frozen=True)
class Scene:
    """What a simulation moves and reads; the same ids in every client.

    Attributes:
        robot: body id of the robot.
        joints: indices of its movable joints.
        ee_link: its link whose centre of mass is the end-effector.
        objects: body ids of the movable objects.
        markers: body ids of the markers that show where the objects should go.
    """

    robot: int
    joints: tuple[int, ...]
    ee_link: int
    objects: tuple[int, ...] = ()
    markers: tuple[int, ...] = ()


class VectorSimulation:
    """``num_envs`` clients that hold the same scene, and the threads that step them.

    The state of all clients lies in float64 tensors that `step` and `reset`
    overwrite in place; copy what is to be kept. Positions are of centres of mass, in
    the world frame.

    Args:
        build: builds the scene in a client; called once per client, in one thread.
        num_envs: number of clients.
        num_threads: number of threads; None means one per core, at most ``num_envs``.
        physics: how the clients integrate.

    Attributes:
        joint_position: (num_envs, n_joints) [rad] or [m].
        joint_velocity: (num_envs, n_joints) [rad/s] or [m/s].
        ee_position: (num_envs, 3) [m].
        ee_velocity: (num_envs, 3) [m/s].
        object_pose: (num_envs, n_objects, 7), position [m] and quaternion xyzw.
        object_velocity: (num_envs, n_objects, 6), linear [m/s] and angular [rad/s].
        marker_pose: (num_envs, n_markers, 7), where `reset` puts the markers.

    Raises:
        BulletError: ``build`` does not build the same in every client.
    """

    def __init__(
        self,
        build: Callable[[PhysicsClient], Scene],
        num_envs: int,
        *,
        num_threads: int | None = None,
        physics: PhysicsParams = EXACT,
    ) -> None:
        if num_threads is None:
            num_threads = os.cpu_count() or 1
        self.n_substeps = physics.n_substeps
        self.ctrl_dt = physics.ctrl_dt
        self._physics = physics
        self._build = build
        self._blueprint: Blueprint | None = None
        self._clients: list[PhysicsClient] = []
        self._broad_phases: list[BroadPhase] = []
        self._pool = WorkerPool(min(num_threads, num_envs))
        try:
            for _ in range(num_envs):
                client = PhysicsClient(physics=physics)
                self._clients.append(client)
                scene = build(client)
                if self._blueprint is None:
                    self.scene, self._blueprint = scene, client.blueprint
                self.check_same(client, scene)
                client.finish_building()
                self._broad_phases.append(BroadPhase(client))
            self._allocate()
        except BaseException:
            self.close()
            raise

    @property
    def num_envs(self) -> int:
        """Number of clients."""
        return len(self._clients)

    @property
    def num_threads(self) -> int:
        """Number of threads that step them."""
        return self._pool.num_threads

    @property
    def clients(self) -> Sequence[PhysicsClient]:
        """The clients, by environment."""
        return self._clients

    def check_same(self, client: SceneClient, scene: Scene) -> None:
        """Make sure that another client holds the scene that these hold.

        Raises:
            BulletError: it does not.
            TypeError: what built it returned no `Scene`.
        """
        if not isinstance(scene, Scene):
            raise TypeError(f"what builds a scene must return a Scene, got {scene!r}")
        assert self._blueprint is not None
        found = (scene, *client.blueprint)
        for there, here in zip(found, (self.scene, *self._blueprint), strict=False):
            if there != here:
                raise BulletError(
                    f"the scene must be the same in every client, got {there} "
                    f"after {here}"
                )
        if len(client.blueprint) != len(self._blueprint):
            raise BulletError(
                f"the scene must be the same in every client, got "
                f"{len(client.blueprint)} commands that build it after "
                f"{len(self._blueprint)}"
            )

    def step(self, control: Control, envs: Sequence[int] | None = None) -> None:
        """Control the robots, advance time and read the state.

        Args:
            control: sets the motors, given a client and its index.
            envs: which clients; None means all.

        Raises:
            WorkerError: Bullet failed in one client; it names the client.
        """
        envs = range(self.num_envs) if envs is None else envs
        step_one = partial(self._step_one, control)
        if not 1 < self.num_threads < len(envs):
            self._pool.run(step_one, envs)
            return
        # At the end of a step, threads that find no work left wait for the others: the
        # last piece of work is but a part of a client's step, so that they wait less.
        last = round(_LAST_PIECE * self.n_substeps)
        pieces = _Pieces(
            partial(self._begin_step, control, self.n_substeps - last),
            partial(self._end_step, last),
        )
        self._pool.run(
            lambda env: (pieces if env == envs[0] else step_one)(env), (*envs, envs[0])
        )

    def run(self, work: Work, envs: Sequence[int]) -> None:
        """Call ``work(env)`` for these environments, in the threads that step them.

        Raises:
            WorkerError: it raised; all others are done nevertheless.
        """
        self._pool.run(work, envs)

    def reset(self, envs: Sequence[int]) -> None:
        """Start an episode from what the state tensors hold for these clients.

        Bullet remembers more than the state. `BroadPhase` makes it forget, so that what
        follows depends on the start state and the actions alone.

        Raises:
            WorkerError: Bullet failed in one client; it names the client.
        """
        self._pool.run(self._reset_one, envs)

    def diverged(self) -> list[int]:
        """The clients whose state is not finite."""
        finite = self._state.isfinite()
        if finite.all():
            return []
        return (~finite).any(dim=1).nonzero().flatten().tolist()

    def rebuild(self, env: int) -> None:
        """Replace a client by a new one: no reset cures Bullet of a NaN."""
        self._clients[env].close()
        client = self._clients[env] = PhysicsClient(physics=self._physics)
        self.check_same(client, self._build(client))
        client.finish_building()
        self._broad_phases[env] = BroadPhase(client)

    def close(self) -> None:
        """Free all clients and end the threads. Closing again does nothing."""
        self._pool.close()
        for client in self._clients:
            client.close()

    def _allocate(self) -> None:
        n, scene = self.num_envs, self.scene
        n_joints, n_objects = len(scene.joints), len(scene.objects)

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(n, *shape, dtype=torch.float64, device="cpu")

        sizes = (n_joints, n_joints, 3, 3, 7 * n_objects, 6 * n_objects)
        # In one tensor, which one check finds finite or not.
        self._state = zeros(sum(sizes))
        (
            self.joint_position,
            self.joint_velocity,
            self.ee_position,
            self.ee_velocity,
            object_pose,
            object_velocity,
        ) = self._state.split(sizes, dim=1)
        self.object_pose = object_pose.unflatten(1, (n_objects, 7))
        self.object_velocity = object_velocity.unflatten(1, (n_objects, 6))
        self.marker_pose = zeros(len(scene.markers), 7)
        # The same memory, part by part, for `_read`: rows of tensors take longer.
        ends = np.cumsum(sizes)[:-1]
        self._rows = [np.split(row, ends) for row in self._state.numpy()]

    def _step_one(self, control: Control, env: int) -> None:
        self._begin_step(control, self.n_substeps, env)
        self._read(env)

    def _begin_step(self, control: Control, substeps: int, env: int) -> None:
        control(self._clients[env], env)
        self._clients[env].step(substeps)

    def _end_step(self, substeps: int, env: int) -> None:
        self._clients[env].step(substeps)
        self._read(env)

    def _reset_one(self, env: int) -> None:
        client, scene = self._clients[env], self.scene
        self._broad_phases[env].restore()
        positions = self.joint_position[env].tolist()
        velocities = self.joint_velocity[env].tolist()
        # One by one and in panda-gym's order: Bullet's broad phase remembers the way.
        for joint, position, velocity in zip(
            scene.joints, positions, velocities, strict=True
        ):
            client.set_joint(scene.robot, joint, position, velocity)
        markers = self.marker_pose[env].tolist()
        for body, pose in zip(scene.markers, markers, strict=True):
            client.set_base(body, pose[:3], pose[3:])
        poses = self.object_pose[env].tolist()
        velocities = self.object_velocity[env].tolist()
        for body, pose, velocity in zip(scene.objects, poses, velocities, strict=True):
            client.set_base(body, pose[:3], pose[3:], velocity[:3], velocity[3:])
        self._read(env)

    def _read(self, env: int) -> None:
        """Copy the state of one client into the tensors."""
        client, scene = self._clients[env], self.scene
        joints, speeds, ee_position, ee_velocity, poses, velocities = self._rows[env]
        state = client.state(scene.robot, link_velocities=True)
        joints[:] = state.joint_positions
        speeds[:] = state.joint_velocities
        ee_position[:] = state.link_pose(scene.ee_link)[:3]
        ee_velocity[:] = state.link_velocity(scene.ee_link)[:3]
        for k, body in enumerate(scene.objects):
            state = client.state(body)
            poses[7 * k : 7 * k + 7] = state.base_pose
            velocities[6 * k : 6 * k + 6] = state.base_velocity
