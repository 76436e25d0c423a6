"""A vector step of all clients in threads of C, without Python."""

import os
from collections.abc import Sequence
from ctypes import POINTER, byref, c_double, c_int, pointer

from torch import Tensor

from torch_panda.bullet import capi, native
from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.client import VELOCITY_GAIN, PhysicsClient
from torch_panda.bullet.connection import BulletError, client_closed, refusal
from torch_panda.bullet.control import MotorControl
from torch_panda.bullet.physics import PhysicsParams
from torch_panda.bullet.pool import WorkerError
from torch_panda.bullet.scene import Scene

# What Bullet could not do, by the status code that it should have answered with.
_ACTIONS = {
    capi.CMD_CALCULATE_INVERSE_KINEMATICS_COMPLETED: "solve the inverse kinematics",
    capi.CMD_DESIRED_STATE_RECEIVED_COMPLETED: "control joints",
    capi.CMD_STEP_FORWARD_SIMULATION_COMPLETED: "step",
    capi.CMD_ACTUAL_STATE_UPDATE_COMPLETED: "report a state",
}


class NativeLoop:
    """Steps clients as ``loop.c`` does, and owns its threads.

    Args:
        clients: the clients, which `replace` may replace.
        scene: what they hold.
        state: (num_envs, k) float64 and contiguous, which every step overwrites: of
            each client what `VectorSimulation` names, in that order.
        physics: how they integrate.
        num_threads: threads that step them, the caller's among them.
    """

    def __init__(
        self,
        clients: Sequence[PhysicsClient],
        scene: Scene,
        state: Tensor,
        *,
        physics: PhysicsParams,
        num_threads: int,
    ) -> None:
        assert native.LIBRARY is not None
        n = len(clients)
        self._library = native.LIBRARY
        self._physics = physics
        self._num_threads = num_threads
        counts = [len(joints) for joints in scene.object_joints]
        native_scene = native.Scene(
            scene.robot,
            scene.ee_link,
            len(scene.joints),
            len(scene.objects),
            sum(counts),
            physics.n_substeps,
            (c_int * len(scene.objects))(*scene.objects),
            (c_int * len(counts))(*counts),
        )
        self._clients = (POINTER(native.Client) * n)()
        self._state = state
        self._failures = (native.Failure * n)()
        # It keeps alive what it points to, but for the tensors.
        self._batch = native.Batch(
            pointer(native.bullet_functions()),
            pointer(native_scene),
            self._clients,
            state.data_ptr(),
            self._failures,
        )
        self._described: MotorControl | None = None  # by _control
        self._control = native.Control()
        self._loop: int | None = None
        self._process = os.getpid()
        for env, client in enumerate(clients):
            self.replace(env, client)

    def replace(self, env: int, client: PhysicsClient) -> None:
        """Step another client from now on."""
        self._clients[env] = pointer(client.native)

    def step(
        self,
        control: MotorControl,
        setpoint: Doubles,
        envs: Sequence[int] | None = None,
    ) -> None:
        """Control, advance and read some clients; None means all.

        Ctrl-C is raised when it is done.

        Args:
            control: what drives the robots.
            setpoint: (num_envs, setpoint_dim) float64 and contiguous.
            envs: which clients, none of them twice.

        Raises:
            WorkerError: Bullet failed in one client; all others are done nevertheless.
        """
        self._start()
        if control is not self._described:
            self._describe(control)
        chosen = range(len(self._clients)) if envs is None else envs
        queue = (c_int * len(chosen))(*chosen)
        failed = self._library.step(
            self._loop, self._control, setpoint.ctypes.data, queue, len(queue)
        )
        if failed:
            errors = {env: self._error(env) for env in sorted(chosen)}
            env, error = next((env, e) for env, e in errors.items() if e)
            raise WorkerError(env, error) from error

    def close(self) -> None:
        """End the threads. Closing again does nothing."""
        # A forked child has none of them.
        if self._loop is not None and self._process == os.getpid():
            self._library.destroy(self._loop)
        self._loop = None

    def _start(self) -> None:
        if self._loop is not None and self._process == os.getpid():
            return
        self._process = os.getpid()
        self._loop = self._library.create(byref(self._batch), self._num_threads)
        if self._loop is None:
            raise MemoryError

    def _describe(self, control: MotorControl) -> None:
        self._control = native.Control(
            -1 if control.ik_link is None else control.ik_link,
            control.num_arm_joints,
            control.setpoint_dim,
            control.ik_orientation is None,
            native.ARM_MODES[control.arm_mode],
            control.ik_orientation or (),
            self._physics.position_gain,
            VELOCITY_GAIN,
            (c_double * len(control.forces))(*control.forces),
        )
        self._described = control

    def _error(self, env: int) -> BulletError | None:
        """Why a client has failed in this step, if it has."""
        expected, answer = self._failures[env].expected, self._failures[env].answer
        if expected == native.CLIENT_CLOSED:
            return client_closed()
        if not expected:
            return None
        code = None if answer == native.NO_ANSWER else answer
        return refusal(_ACTIONS[expected], code, expected)
