"""Many copies of one scene, stepped in parallel."""

import os
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.broad_phase import BroadPhase
from torch_panda.bullet.checks import all_finite
from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.control import Control, MotorControl
from torch_panda.bullet.euler import euler_angles
from torch_panda.bullet.link_client import Blueprint, LinkClient
from torch_panda.bullet.native import loop_name
from torch_panda.bullet.native_loop import NativeLoop
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.pool import Work, WorkerPool
from torch_panda.bullet.scene import Scene


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
        ee_orientation: (num_envs, 4), quaternion xyzw.
        object_pose: (num_envs, n_objects, 7), position [m] and quaternion xyzw.
        object_velocity: (num_envs, n_objects, 6), linear [m/s] and angular [rad/s].
        object_joint_position: (num_envs, n_object_joints) [rad] or [m], of all joints
            of the first object, then of the next.
        object_joint_velocity: (num_envs, n_object_joints) [rad/s] or [m/s].
        object_euler: (num_envs, n_objects, 3), the pose's roll, pitch and yaw [rad] as
            `step` and `reset` leave it; `reset` does not start from it.
        marker_pose: (num_envs, n_markers, 7), where `reset` puts the markers.

    Raises:
        BulletError: ``build`` does not build the same in every client.
        ValueError: the environment variable asks for a loop that there is not.
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
        is_native = loop_name() == "native"
        self.n_substeps = physics.n_substeps
        self.ctrl_dt = physics.ctrl_dt
        self._physics = physics
        self._build = build
        self._blueprint: Blueprint | None = None
        self._clients: list[PhysicsClient] = []
        self._broad_phases: list[BroadPhase] = []
        self._pool = WorkerPool(min(num_threads, num_envs))
        self._native: NativeLoop | None = None
        try:
            for _ in range(num_envs):
                self._clients.append(PhysicsClient(physics=physics))
                self._broad_phases.append(self._build_in(self._clients[-1]))
            self._allocate()
            if is_native:
                self._native = NativeLoop(
                    self._clients,
                    self.scene,
                    self._state,
                    physics=physics,
                    num_threads=self.num_threads,
                )
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

    def check_same(self, client: LinkClient, scene: Scene) -> None:
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

    def step(
        self, control: Control, setpoint: Doubles, envs: Sequence[int] | None = None
    ) -> None:
        """Control the robots, advance time and read the state.

        In C where that was compiled and ``control`` is data, else in Python threads:
        the numbers are the same.

        Args:
            control: sets the motors.
            setpoint: (num_envs, k) float64, a row for each client's robot.
            envs: which clients; None means all.

        Raises:
            WorkerError: Bullet failed in one client; it names the client.
            ValueError: ``control`` needs another ``setpoint``, or another robot.
        """
        setpoint = np.ascontiguousarray(setpoint, dtype=np.float64)
        if isinstance(control, MotorControl):
            control.check(setpoint, self.num_envs, len(self.scene.joints))
            if self._native is not None:
                self._pool.wait()  # after a second Ctrl-C, its threads may be at work
                self._native.step(control, setpoint, envs)
                return

        def step_one(env: int) -> None:
            client = self._clients[env]
            control(client, self.scene.robot, setpoint[env])
            if isinstance(control, MotorControl):
                control.advance(
                    client, self.scene.robot, setpoint[env], self.n_substeps
                )
            else:
                client.step(self.n_substeps)
            self._read(env)

        self._pool.run(step_one, range(self.num_envs) if envs is None else envs)

    def run(self, work: Work, envs: Sequence[int]) -> None:
        """Call ``work(env)`` for these environments, in the threads that step them.

        Raises:
            WorkerError: it raised; all others are done nevertheless.
        """
        self._pool.run(work, envs)

    def reset(self, envs: Sequence[int], vary: Work | None = None) -> None:
        """Start an episode from what the state tensors hold for these clients.

        Bullet remembers more than the state. `BroadPhase` makes it forget, so that what
        follows depends on the start state and the actions alone.

        Args:
            envs: which clients.
            vary: is called with each of them first, in the thread that resets it, to
                change its physics.

        Raises:
            WorkerError: Bullet or ``vary`` failed in one client; it names the client.
        """

        def reset_one(env: int) -> None:
            if vary is not None:
                vary(env)
            self._reset_one(env)

        self._pool.run(reset_one, envs)

    def diverged(self) -> list[int]:
        """The clients whose state is not finite."""
        if all_finite(self._state):
            return []
        return (~self._state.isfinite()).any(dim=1).nonzero().flatten().tolist()

    def rebuild(self, env: int) -> None:
        """Replace a client by a new one: no reset cures Bullet of a NaN."""
        self._clients[env].close()
        client = self._clients[env] = PhysicsClient(physics=self._physics)
        self._broad_phases[env] = self._build_in(client)
        if self._native is not None:
            self._native.replace(env, client)

    def close(self) -> None:
        """Free all clients and end the threads. Closing again does nothing."""
        self._pool.close()
        if self._native is not None:
            self._native.close()
        for client in self._clients:
            client.close()

    def _build_in(self, client: PhysicsClient) -> BroadPhase:
        """Build the scene in a client; return the way back to it."""
        scene = self._build(client)
        if self._blueprint is None:
            self.scene, self._blueprint = scene, client.blueprint
        self.check_same(client, scene)
        client.finish_building()
        return BroadPhase(client)

    def _allocate(self) -> None:
        n, scene = self.num_envs, self.scene
        n_joints, n_objects = len(scene.joints), len(scene.objects)
        found = len(self._clients[0].state(scene.robot).joint_positions)
        if found != n_joints:
            raise BulletError(
                f"a scene must name the robot's {found} joints of one degree of "
                f"freedom, got {n_joints}"
            )

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(n, *shape, dtype=torch.float64, device="cpu")

        # Objects that have joints: their ids, joints, and where in the tensors.
        self._jointed_objects: list[tuple[int, tuple[int, ...], slice]] = []
        n_more = 0
        for body, joints in zip(scene.objects, scene.object_joints, strict=True):
            if joints:
                own = slice(n_more, n_more + len(joints))
                self._jointed_objects.append((body, joints, own))
                n_more += len(joints)
        arm = (n_joints, n_joints, 3, 3, 4)
        sizes = (*arm, 7 * n_objects, 6 * n_objects, n_more, n_more, 3 * n_objects)
        # In one tensor, which one check finds finite or not.
        self._state = zeros(sum(sizes))
        (
            self.joint_position,
            self.joint_velocity,
            self.ee_position,
            self.ee_velocity,
            self.ee_orientation,
            object_pose,
            object_velocity,
            self.object_joint_position,
            self.object_joint_velocity,
            object_euler,
        ) = self._state.split(sizes, dim=1)
        self.object_pose = object_pose.unflatten(1, (n_objects, 7))
        self.object_velocity = object_velocity.unflatten(1, (n_objects, 6))
        self.object_euler = object_euler.unflatten(1, (n_objects, 3))
        self.marker_pose = zeros(len(scene.markers), 7)
        # The same memory, part by part, for `_read`: rows of tensors take longer.
        ends = np.cumsum(sizes)[:-1]
        self._rows = [np.split(row, ends) for row in self._state.numpy()]

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
        positions = self.object_joint_position[env].tolist()
        velocities = self.object_joint_velocity[env].tolist()
        for body, joints, own in self._jointed_objects:
            client.set_joints(body, joints, positions[own], velocities[own])
        self._read(env)

    def _read(self, env: int) -> None:
        """Copy the state of one client into the tensors."""
        client, scene = self._clients[env], self.scene
        joints, speeds, ee_position, ee_velocity, ee_orientation, *objects = self._rows[
            env
        ]
        poses, velocities, object_joints, object_speeds, angles = objects
        state = client.state(scene.robot, link_velocities=True)
        joints[:] = state.joint_positions
        speeds[:] = state.joint_velocities
        pose = state.link_pose(scene.ee_link)
        ee_position[:], ee_orientation[:] = pose[:3], pose[3:]
        ee_velocity[:] = state.link_velocity(scene.ee_link)[:3]
        for k, body in enumerate(scene.objects):
            state = client.state(body)
            poses[7 * k : 7 * k + 7] = state.base_pose
            velocities[6 * k : 6 * k + 6] = state.base_velocity
            angles[3 * k : 3 * k + 3] = euler_angles(*state.base_pose[3:].tolist())
        for body, _, own in self._jointed_objects:
            state = client.state(body)
            object_joints[own] = state.joint_positions
            object_speeds[own] = state.joint_velocities
