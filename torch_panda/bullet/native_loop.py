"""Steps and resets all clients in threads of C, without Python."""

import os
from collections.abc import Iterable, Sequence
from ctypes import POINTER, Array, c_int, pointer

from torch_panda.bullet import native
from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.client import VELOCITY_GAIN, PhysicsClient
from torch_panda.bullet.connection import BulletError, client_closed, doubles, refusal
from torch_panda.bullet.control import MotorControl
from torch_panda.bullet.physics import PhysicsParams
from torch_panda.bullet.pool import WorkerError
from torch_panda.bullet.scene import Scene
from torch_panda.bullet.state import SimulationState


class NativeLoop:
    """Owns the C threads of ``loop.c``, which step and reset the clients.

    Args:
        clients: The clients.
        scene: Body ids of the scene.
        state: Tensors that steps overwrite and from which resets start.
        physics: Parameters of the integration.
        num_threads: Number of threads, including the caller's.
    """

    def __init__(
        self,
        clients: Sequence[PhysicsClient],
        scene: Scene,
        state: SimulationState,
        *,
        physics: PhysicsParams,
        num_threads: int,
    ) -> None:
        assert native.LIBRARY is not None
        n = len(clients)
        self._library = native.LIBRARY
        self._physics = physics
        self._num_threads = num_threads
        object_joints = [k for joints in scene.object_joints for k in joints]
        native_scene = native.Scene(
            scene.robot,
            scene.ee_link,
            len(scene.joints),
            len(scene.objects),
            len(object_joints),
            len(scene.markers),
            physics.n_substeps,
            ints(scene.joints),
            ints(scene.objects),
            ints(map(len, scene.object_joints)),
            ints(object_joints),
            ints(scene.markers),
        )
        self._clients = (POINTER(native.Client) * n)()
        self._state = state
        # Outcome of each client's last step or reset. The field `expected` is 0 if
        # nothing failed, DIVERGED if the state is not finite, and CLIENT_CLOSED if the
        # client is closed. Otherwise a command failed, and `expected` is the status
        # code with which it would have succeeded.
        self._failures = (native.Failure * n)()
        # A ctypes struct keeps alive the objects that it points to. It has only the
        # addresses of tensors, so `self._state` keeps the tensors alive.
        self._batch = native.Batch(
            pointer(native.bullet_functions()),
            pointer(native_scene),
            self._clients,
            state.rows.data_ptr(),
            state.marker_pose.data_ptr(),
            self._failures,
        )
        # The control and the setpoints of the last step, and their conversions for C.
        self._motor_control: MotorControl | None = None
        self._control = native.Control()
        self._setpoint: Doubles | None = None
        self._setpoint_address = 0
        self._loop: int | None = None
        self._process = os.getpid()
        for env, client in enumerate(clients):
            self.replace(env, client)

    def replace(self, env: int, client: PhysicsClient) -> None:
        """Use another client for an environment from now on."""
        self._clients[env] = pointer(client.native)

    def step(
        self, control: MotorControl, setpoint: Doubles, envs: Sequence[int] | None
    ) -> list[int]:
        """Set the motors, advance time and read the state; see `VectorSimulation.step`.

        Ctrl-C raises when the step is done. ``setpoint`` must be contiguous float64,
        and ``envs`` must have no duplicates.
        """
        self._start()
        if control is not self._motor_control:
            self._control = self._convert(control)
            self._motor_control = control
        if setpoint is not self._setpoint:
            self._setpoint, self._setpoint_address = setpoint, setpoint.ctypes.data
        chosen = range(len(self._clients)) if envs is None else envs
        queue = (c_int * len(chosen))(*chosen)
        if not self._library.step(
            self._loop, self._control, self._setpoint_address, queue, len(queue)
        ):
            return []
        self._raise_first_error(chosen)
        failures = self._failures
        return [e for e in chosen if failures[e].expected == native.DIVERGED]

    def reset(self, envs: Sequence[int]) -> None:
        """Move bodies to the start of an episode; see `VectorSimulation.reset`."""
        self._start()
        queue = (c_int * len(envs))(*envs)
        if self._library.reset(self._loop, queue, len(queue)):
            self._raise_first_error(envs)

    def reset_one(self, env: int) -> None:
        """Reset one client in the calling thread; see `reset`.

        Raises:
            BulletError: Bullet failed, or the client is closed.
        """
        self._library.reset_one(self._batch, env)
        if error := self._error(env):
            raise error

    def close(self) -> None:
        """End the threads. Closing again does nothing."""
        # Ctrl-C raises after `destroy` has freed the loop, so forget it before.
        loop, self._loop = self._loop, None
        # A forked child has no threads of the loop.
        if loop is not None and self._process == os.getpid():
            self._library.destroy(loop)

    def _start(self) -> None:
        """Start the threads, unless this process has started them already."""
        if self._loop is not None and self._process == os.getpid():
            return
        self._process = os.getpid()
        self._loop = self._library.create(self._batch, self._num_threads)
        if self._loop is None:
            raise MemoryError

    def _convert(self, control: MotorControl) -> native.Control:
        return native.Control(
            ik_link=-1 if control.ik_link is None else control.ik_link,
            num_arm_joints=control.num_arm_joints,
            setpoint_size=control.setpoint_dim,
            # Setpoints contain the orientation unless the control fixes it.
            has_orientation=control.ik_orientation is None,
            arm_mode=native.ARM_MODES[control.arm_mode],
            ik_iterations=self._physics.ik_iterations,
            orientation=control.ik_orientation or (),
            position_gain=self._physics.position_gain,
            velocity_gain=VELOCITY_GAIN,
            forces=doubles(control.forces),
            ik_damping=doubles([self._physics.ik_damping] * len(control.forces)),
        )

    def _raise_first_error(self, envs: Sequence[int]) -> None:
        """Raise the error of the first client that failed; divergence is no error."""
        for env in sorted(envs):
            if error := self._error(env):
                raise WorkerError(env, error) from error

    def _error(self, env: int) -> BulletError | None:
        """The error of a client in the last step or reset; None if it did not fail."""
        failure = self._failures[env]
        if failure.expected == native.CLIENT_CLOSED:
            return client_closed()
        if failure.expected in (0, native.DIVERGED):
            return None
        code = None if failure.answer == native.NO_ANSWER else failure.answer
        return refusal(failure.action.decode(), code, failure.expected)


def ints(values: Iterable[int]) -> "Array[c_int]":
    """A C array of integers."""
    values = tuple(values)
    return (c_int * len(values))(*values)
