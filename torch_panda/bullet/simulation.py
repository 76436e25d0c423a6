"""Many clients of one scene, stepped in parallel."""

import copy
from collections.abc import Callable, Sequence
from ctypes import pointer

from typing_extensions import Self

from torch_panda.bullet.blueprint import Blueprint
from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.broad_phase import plan_restoration
from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.connection import BulletError
from torch_panda.bullet.control import Control, MotorControl
from torch_panda.bullet.loop import Loop, load_library
from torch_panda.bullet.physics import EXACT, PhysicsParams
from torch_panda.bullet.pool import Work, WorkerPool, num_cores
from torch_panda.bullet.scene import Scene
from torch_panda.bullet.state import SimulationState


class VectorSimulation:
    """Builds one scene in ``num_envs`` clients, and steps them in parallel threads.

    Args:
        build: Function that builds the scene in a client. It is called for one client
            after another and must build the same scene every time.
        num_envs: Number of clients.
        num_threads: Number of threads, at most ``num_envs``. None means one per core
            that the process may use.
        physics: Parameters of the integration.

    Raises:
        BulletError: ``build`` built a different scene in a later client.
        TypeError: ``build`` did not return a `Scene`.
        ImportError: The C library is missing, or was compiled from other C files.

    Attributes:
        scene: Body ids of the scene.
        state: Tensors with the state of all clients; see `SimulationState`. Steps and
            resets overwrite them: copy the ones that you keep. The tensors that tasks
            read are also attributes of the simulation, for example
            ``simulation.ee_position`` (num_envs, 3) [m].
        ee_frame: Pose of the end-effector in the URDF's frame of the robot's
            ``ee_link``; see `PhysicsClient.inertial_frame`.
        n_substeps: Number of substeps per step.
        ctrl_dt: Length of a step [s].
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
            num_threads = num_cores()
        load_library()  # raises before scenes are built, which takes long
        self.n_substeps = physics.n_substeps
        self.ctrl_dt = physics.ctrl_dt
        self._physics = physics
        self._scene_builder = build
        self._clients: list[PhysicsClient] = []
        self._pool = WorkerPool(min(num_threads, num_envs))
        self._indices = frozenset(range(num_envs))
        try:
            client = PhysicsClient(physics=physics)
            self._clients.append(client)
            self.scene = _build_scene(build, client)
            self._check_joints()
            self.ee_frame = client.inertial_frame(self.scene.robot, self.scene.ee_link)
            self._blueprint = client.blueprint
            for _ in range(1, num_envs):
                self._clients.append(PhysicsClient(physics=physics))
                self._build_same_scene(self._clients[-1])
            self._use_state(SimulationState(self.scene, num_envs))
            self._loop = Loop(
                self._clients,
                self.scene,
                self.state,
                physics=physics,
                num_threads=self.num_threads,
            )
            # This is half of the work of building a client, so use all threads. The
            # scenes above are built one by one, because users write that code.
            self._pool.run(self._plan_resets, range(num_envs))
            self._pool.close()  # it starts again where Python code needs threads
        except BaseException:
            self._free_clients()
            raise

    @property
    def num_envs(self) -> int:
        """Number of clients."""
        return len(self._clients)

    @property
    def num_threads(self) -> int:
        """Number of threads."""
        return self._pool.num_threads

    @property
    def clients(self) -> Sequence[PhysicsClient]:
        """The clients, by index of the environment."""
        return self._clients

    @property
    def blueprint(self) -> Blueprint:
        """The commands that built the scene, the same in every client."""
        return self._blueprint

    def with_state(self, state: SimulationState) -> Self:
        """A view with other tensors, for functions that read the state of a simulation.

        It shares the clients. A step or a reset does not write into its tensors.
        """
        view = copy.copy(self)
        view._use_state(state)
        return view

    def _use_state(self, state: SimulationState) -> None:
        """Make the tensors that tasks, robots and sensors read attributes."""
        self.state = state
        self.joint_position = state.joint_position
        self.joint_velocity = state.joint_velocity
        self.ee_position = state.ee_position
        self.ee_velocity = state.ee_velocity
        self.ee_state = state.ee_state
        self.ee_orientation = state.ee_orientation
        self.object_pose = state.object_pose
        self.object_position = state.object_position
        self.object_state = state.object_state
        self.object_velocity = state.object_velocity
        self.object_euler = state.object_euler
        self.object_joint_position = state.object_joint_position
        self.object_joint_velocity = state.object_joint_velocity
        self.marker_pose = state.marker_pose

    # ---- steps and resets --------------------------------------------------------

    def step(
        self, control: Control, setpoint: Doubles, envs: Sequence[int] | None = None
    ) -> list[int]:
        """Set the motors, advance time and read the state.

        For a `MotorControl`, threads of C do this without Python. For a control written
        in Python, threads of Python call it and then advance time.

        Args:
            control: Control of the robots.
            setpoint: Setpoints (num_envs, k) float64, a row per robot.
            envs: Indices of the clients to step; None means all.

        Returns:
            Indices of the stepped clients whose state is not finite.

        Raises:
            WorkerError: Bullet failed in one or more clients. The error names the first
                of them. Every client that did not fail took the step.
            ValueError: ``control`` does not fit the setpoints or the robot, or
                ``envs`` has an index twice or one that is out of range.
        """
        if envs is not None:
            self._check_indices(envs)
        stepped = range(self.num_envs) if envs is None else envs
        if isinstance(control, MotorControl):
            if not self._loop.step(control, setpoint, stepped):
                return []
        else:
            self._step_in_python(control, setpoint, stepped)
        return [env for env in self.diverged() if env in stepped]

    def _step_in_python(
        self, control: Control, setpoint: Doubles, envs: Sequence[int]
    ) -> None:
        """Step with a control that is written in Python; see `step`."""

        def step_one(env: int) -> None:
            client = self._clients[env]
            control(client, self.scene.robot, setpoint[env])
            client.step(self.n_substeps)
            self._loop.read(env)

        self._pool.run(step_one, envs)

    def run(self, work: Work, envs: Sequence[int]) -> None:
        """Call ``work(env)`` for some environments in the simulation's threads.

        Raises:
            WorkerError: ``work`` raised for at least one environment. The calls for all
                others were completed.
        """
        self._pool.run(work, envs)

    def reset(self, envs: Sequence[int], randomize: Work | None = None) -> None:
        """Move the bodies of clients to the start of an episode.

        Before the call, write the start into the tensors of the attribute `state`. The
        reset moves the bodies there. It then overwrites these tensors, except
        ``marker_pose``, with the state that Bullet reports.

        The reset also restores Bullet's broad phase, so that an episode depends on its
        start and its actions only. See ``broad_phase.py``.

        Args:
            envs: Indices of the clients to reset.
            randomize: Called with the index of each environment before its reset, in
                the same thread, to change the physics of its client.

        Raises:
            WorkerError: Bullet or ``randomize`` failed in one or more clients. The
                error names the first of them. Every client that did not fail was reset.
            ValueError: ``envs`` has an index twice or one that is out of range.
        """
        self._check_indices(envs)
        if randomize is None:
            self._loop.reset(envs)
            return

        def reset_one(env: int) -> None:
            randomize(env)
            self._loop.reset_one(env)

        self._pool.run(reset_one, envs)

    def diverged(self) -> list[int]:
        """Indices of the clients whose state was not finite when it was last read."""
        clients = enumerate(self._clients)
        return [env for env, client in clients if client.struct.has_diverged]

    def rebuild(self, env: int) -> None:
        """Replace a diverged client by a new one: no reset removes NaN from Bullet."""
        self._clients[env].close()
        client = self._clients[env] = PhysicsClient(physics=self._physics)
        self._build_same_scene(client)
        self._loop.replace(env, client)
        self._plan_resets(env)

    def close(self) -> None:
        """Free all clients and end all threads. Closing again does nothing."""
        self._loop.close()
        self._free_clients()

    def _free_clients(self) -> None:
        self._pool.close()
        for client in self._clients:
            client.close()

    def _build_same_scene(self, client: PhysicsClient) -> None:
        """Build the scene in a later client; raise if it differs from the first."""
        scene = _build_scene(self._scene_builder, client)
        first, other = (self.scene, *self._blueprint), (scene, *client.blueprint)
        for expected, actual in zip(first, other, strict=False):
            if actual != expected:
                raise BulletError(
                    f"the scene must be the same in every client: the first client has "
                    f"{expected}, and a later client has {actual}; draw random numbers "
                    f"in resets, not in build"
                )
        if len(other) != len(first):
            raise BulletError(
                f"the scene must be the same in every client: {len(first) - 1} "
                f"commands built it in the first client, and {len(other) - 1} in a "
                f"later one"
            )

    def _plan_resets(self, env: int) -> None:
        """Plan the resets of a client that was just built."""
        plan = plan_restoration(self._clients[env])
        self._clients[env].struct.broad_phase = pointer(plan)
        self._loop.restore(env)

    def _check_indices(self, envs: Sequence[int]) -> None:
        """Refuse indices with which threads of C would crash the interpreter.

        C code does not check that a client exists. If an index occurs twice, two
        threads could use the same client.
        """
        if len(self._indices.intersection(envs)) != len(envs):
            raise ValueError(
                f"envs must be different indices from 0 to {self.num_envs - 1}, got "
                f"{list(envs)}"
            )

    def _check_joints(self) -> None:
        """Check that the scene lists as many joints as Bullet's robot has."""
        scene = self.scene
        count = len(self._clients[0].state(scene.robot).joint_positions)
        if count != len(scene.joints):
            raise BulletError(
                f"a scene must list the robot's {count} joints of one degree of "
                f"freedom, got {len(scene.joints)}"
            )


def _build_scene(
    build: Callable[[PhysicsClient], Scene], client: PhysicsClient
) -> Scene:
    """Build a scene in a new client."""
    scene = build(client)
    if not isinstance(scene, Scene):
        raise TypeError(
            f"a function that builds a scene must return a Scene, got {scene!r}"
        )
    client.finish_building()
    return scene
