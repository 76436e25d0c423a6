"""Many copies of one scene, stepped in parallel."""

import os
import threading
from collections.abc import Callable, Sequence
from ctypes import memmove
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from torch_panda.bullet.built_world import BuiltWorld
from torch_panda.bullet.client import BulletError, PhysicsClient, doubles
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.pool import Work, WorkerPool

ControlType = Literal["ee", "joints"]

_DOUBLE = 8  # bytes
# Share of a client's substeps. Of 0.3 and 0.5 the better, by the durations of Push.
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
    """What a simulation drives and reads; the same ids in every client.

    Attributes:
        robot: body id of the robot.
        ee_link: its link whose centre of mass is the end-effector.
        ee_orientation: quaternion xyzw that inverse kinematics aims at, world frame.
        num_arm_joints: how many of its joints, the first ones, inverse kinematics sets.
        joint_forces: the most each movable joint's motor may exert [N m] or [N].
        joints: indices of its movable joints.
        objects: body ids of the movable objects.
        targets: body ids of the markers that show where the objects should go.
    """

    robot: int
    joints: tuple[int, ...]
    ee_link: int
    ee_orientation: tuple[float, float, float, float]
    num_arm_joints: int
    joint_forces: tuple[float, ...]
    objects: tuple[int, ...] = ()
    targets: tuple[int, ...] = ()


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
        target_pose: (num_envs, n_targets, 7), where `reset` puts the markers.
        joint_target: (num_envs, n_joints), what `step` drives the joints to.
        ee_target: (num_envs, 3) [m], what `step` solves the arm's targets for when
            the control type is "ee".
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
        self.dt = physics.dt
        self._make_client = partial(PhysicsClient, physics=physics)
        self._build = build
        self._clients: list[PhysicsClient] = []
        self._built_worlds: list[BuiltWorld] = []
        self._pool = WorkerPool(min(num_threads, num_envs))
        try:
            for _ in range(num_envs):
                client = self._make_client()
                self._clients.append(client)
                scene = build(client)
                self._built_worlds.append(BuiltWorld(client))
                if client is self._clients[0]:
                    self.scene = scene
                elif scene != self.scene:
                    raise BulletError(
                        f"the scene must be the same in every client, got {scene} "
                        f"after {self.scene}"
                    )
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

    def step(
        self, control_type: ControlType, envs: Sequence[int] | None = None
    ) -> None:
        """Control the joints, advance time and read the state.

        Args:
            control_type: "joints" drives the joints to ``joint_target``; "ee" first
                replaces the arm's targets by the inverse kinematics of ``ee_target``.
            envs: which clients; None means all.

        Raises:
            WorkerError: Bullet failed in one client; it names the client.
        """
        control = self._control_ee if control_type == "ee" else self._control_joints
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

    @property
    def clients(self) -> Sequence[PhysicsClient]:
        """The clients, by environment."""
        return self._clients

    def run(self, work: Work, envs: Sequence[int]) -> None:
        """Call ``work(env)`` for these environments, in the threads that step them.

        Raises:
            WorkerError: it raised; all others are done nevertheless.
        """
        self._pool.run(work, envs)

    def reset(self, envs: Sequence[int]) -> None:
        """Start an episode from what the state tensors hold for these clients.

        Bullet remembers more than the state. `BuiltWorld` makes it forget, so that what
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
        client = self._clients[env] = self._make_client()
        self._build(client)
        self._built_worlds[env] = BuiltWorld(client)

    def close(self) -> None:
        """Free all clients and end the threads. Closing again does nothing."""
        self._pool.close()
        for client in self._clients:
            client.close()

    def _allocate(self) -> None:
        n, scene = self.num_envs, self.scene
        n_joints, n_objects = len(scene.joint_forces), len(scene.objects)

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(n, *shape, dtype=torch.float64, device="cpu")

        sizes = (n_joints, n_joints, 3, 3, 7 * n_objects, 6 * n_objects)
        # In one tensor, which one look finds finite or not.
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
        self.joint_target = zeros(n_joints)
        self.ee_target = zeros(3)
        self.target_pose = zeros(len(scene.targets), 7)
        self._ik_result = zeros(n_joints)
        self._forces = doubles(scene.joint_forces)
        self._ee_orientation = torch.tensor(
            scene.ee_orientation, dtype=torch.float64, device="cpu"
        )

    def _step_one(self, control: Work, env: int) -> None:
        self._begin_step(control, self.n_substeps, env)
        self._read(env)

    def _begin_step(self, control: Work, substeps: int, env: int) -> None:
        control(env)
        self._clients[env].step(substeps)

    def _end_step(self, substeps: int, env: int) -> None:
        self._clients[env].step(substeps)
        self._read(env)

    def _control_ee(self, env: int) -> None:
        scene = self.scene
        solution = _row(self._ik_result, env)
        self._clients[env].inverse_kinematics(
            scene.robot,
            scene.ee_link,
            _row(self.ee_target, env),
            self._ee_orientation.data_ptr(),
            solution,
        )
        memmove(_row(self.joint_target, env), solution, _DOUBLE * scene.num_arm_joints)
        self._control_joints(env)

    def _control_joints(self, env: int) -> None:
        self._clients[env].control_joints(
            self.scene.robot, _row(self.joint_target, env), self._forces
        )

    def _reset_one(self, env: int) -> None:
        client, scene = self._clients[env], self.scene
        self._built_worlds[env].restore()
        positions = self.joint_position[env].tolist()
        velocities = self.joint_velocity[env].tolist()
        # One by one and in panda-gym's order: Bullet's broad phase remembers the way.
        for joint, position, velocity in zip(
            scene.joints, positions, velocities, strict=True
        ):
            client.set_joint(scene.robot, joint, position, velocity)
        for body, pose in zip(
            scene.targets, self.target_pose[env].tolist(), strict=True
        ):
            client.set_base(body, pose[:3], pose[3:])
        poses = self.object_pose[env].tolist()
        velocities = self.object_velocity[env].tolist()
        for body, pose, velocity in zip(scene.objects, poses, velocities, strict=True):
            client.set_base(body, pose[:3], pose[3:], velocity[:3], velocity[3:])
        self._read(env)

    def _read(self, env: int) -> None:
        """Copy the state of one client into the tensors."""
        client, scene = self._clients[env], self.scene
        state = client.state(scene.robot, link_velocities=True)
        size = _DOUBLE * len(scene.joint_forces)
        memmove(_row(self.joint_position, env), state.joint_positions, size)
        memmove(_row(self.joint_velocity, env), state.joint_velocities, size)
        position, velocity = _row(self.ee_position, env), _row(self.ee_velocity, env)
        memmove(position, state.link_pose(scene.ee_link), _DOUBLE * 3)
        memmove(velocity, state.link_velocity(scene.ee_link), _DOUBLE * 3)
        pose, velocity = _row(self.object_pose, env), _row(self.object_velocity, env)
        for body in scene.objects:
            state = client.state(body)
            memmove(pose, state.q, _DOUBLE * 7)
            memmove(velocity, state.u, _DOUBLE * 6)
            pose += _DOUBLE * 7
            velocity += _DOUBLE * 6


def _row(tensor: Tensor, env: int) -> int:
    """Address of one environment's part of a float64 tensor, which is contiguous."""
    return tensor.data_ptr() + _DOUBLE * tensor.stride(0) * env
