"""Many copies of one scene, stepped in parallel."""

import os
from collections.abc import Callable, Sequence

import numpy as np

from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.broad_phase import BroadPhase
from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.control import Control, MotorControl
from torch_panda.bullet.link_client import Blueprint, LinkClient
from torch_panda.bullet.native import loop_name
from torch_panda.bullet.native_loop import NativeLoop
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.pool import Work, WorkerPool
from torch_panda.bullet.scene import Scene
from torch_panda.bullet.scene_state import SceneState


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
        ee_state: (num_envs, 6), both.
        ee_orientation: (num_envs, 4), quaternion xyzw.
        object_pose: (num_envs, n_objects, 7), position [m] and quaternion xyzw.
        object_state: (num_envs, n_objects, 12), position, Euler angles and velocity.
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
            self._check_joints()
            self._state = SceneState(self.scene, num_envs)
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
        self.joint_position = self._state.joint_position
        self.joint_velocity = self._state.joint_velocity
        self.ee_position = self._state.ee_position
        self.ee_velocity = self._state.ee_velocity
        self.ee_state = self._state.ee_state
        self.ee_orientation = self._state.ee_orientation
        self.object_pose = self._state.object_pose
        self.object_state = self._state.object_state
        self.object_velocity = self._state.object_velocity
        self.object_joint_position = self._state.object_joint_position
        self.object_joint_velocity = self._state.object_joint_velocity
        self.object_euler = self._state.object_euler
        self.marker_pose = self._state.marker_pose

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
    ) -> list[int]:
        """Control the robots, advance time and read the state.

        In C where that was compiled and ``control`` is data, else in Python threads:
        the numbers are the same.

        Args:
            control: sets the motors.
            setpoint: (num_envs, k) float64, a row for each client's robot.
            envs: which clients; None means all.

        Returns:
            the clients whose state is not finite.

        Raises:
            WorkerError: Bullet failed in one client; it names the client.
            ValueError: ``control`` needs another ``setpoint``, or another robot.
        """
        setpoint = np.ascontiguousarray(setpoint, dtype=np.float64)
        if isinstance(control, MotorControl):
            control.check(setpoint, self.num_envs, len(self.scene.joints))
            if self._native is not None:
                self._pool.wait()  # after a second Ctrl-C, its threads may be at work
                return self._native.step(control, setpoint, envs)

        def step_one(env: int) -> None:
            client = self._clients[env]
            control(client, self.scene.robot, setpoint[env])
            if isinstance(control, MotorControl):
                control.advance(
                    client, self.scene.robot, setpoint[env], self.n_substeps
                )
            else:
                client.step(self.n_substeps)
            self._state.read(env, client)

        self._pool.run(step_one, range(self.num_envs) if envs is None else envs)
        return self.diverged()

    def run(self, work: Work, envs: Sequence[int]) -> None:
        """Call ``work(env)`` for these environments, in the threads that step them.

        Raises:
            WorkerError: it raised; all others are done nevertheless.
        """
        self._pool.run(work, envs)

    def reset(self, envs: Sequence[int], vary: Work | None = None) -> None:
        """Start an episode from what the state tensors hold for these clients.

        Bullet remembers more than the state. `BroadPhase` makes it forget, so that what
        follows depends on the start state and the actions alone. In C where that was
        compiled, else in Python: the numbers are the same.

        Args:
            envs: which clients.
            vary: is called with each of them first, in the thread that resets it, to
                change its physics.

        Raises:
            WorkerError: Bullet or ``vary`` failed in one client; it names the client.
        """
        if self._native is not None and vary is None:
            self._pool.wait()
            self._native.reset(envs)
            return

        def reset_one(env: int) -> None:
            if vary is not None:
                vary(env)
            if self._native is not None:
                self._native.reset_one(env)
                return
            client = self._clients[env]
            self._broad_phases[env].restore()
            self._state.place(env, client)
            self._state.read(env, client)

        self._pool.run(reset_one, envs)

    def diverged(self) -> list[int]:
        """The clients whose state, as it was last read, is not finite."""
        return self._state.diverged()

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

    def _check_joints(self) -> None:
        """Make sure that a robot's state is that of its joints, and of no others."""
        scene = self.scene
        found = len(self._clients[0].state(scene.robot).joint_positions)
        if found != len(scene.joints):
            raise BulletError(
                f"a scene must name the robot's {found} joints of one degree of "
                f"freedom, got {len(scene.joints)}"
            )
