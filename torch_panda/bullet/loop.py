"""Steps and resets all clients in threads of C, without Python."""

import ctypes
import functools
import os
import zlib
from collections.abc import Iterable, Sequence
from ctypes import POINTER, Array, c_int, c_uint32, c_void_p, pointer
from pathlib import Path

import numpy as np

from torch_panda.bullet import structs
from torch_panda.bullet.body_state import Doubles
from torch_panda.bullet.client import VELOCITY_GAIN, PhysicsClient
from torch_panda.bullet.connection import BulletError, client_closed, doubles, refusal
from torch_panda.bullet.control import MotorControl
from torch_panda.bullet.library import bind
from torch_panda.bullet.physics import PhysicsParams
from torch_panda.bullet.pool import WorkerError
from torch_panda.bullet.scene import Scene
from torch_panda.bullet.state import SimulationState

_SOURCES = Path(__file__).parent / "csrc"
# setuptools gives the library this name, see pyproject.toml.
_LIBRARY = Path(__file__).with_name("_loop.abi3.so")


@functools.cache
def load_library() -> ctypes.CDLL:
    """Load the library that setuptools compiles from the C files in ``csrc/``.

    Its functions release the GIL during a call.

    Raises:
        ImportError: The library is missing, or was compiled from other files.
    """
    try:
        library = ctypes.CDLL(str(_LIBRARY))
    except OSError as error:
        raise ImportError(
            f"torch_panda cannot load its compiled loop ({error}). With a C compiler "
            f"installed, compile it: {_install_command()}"
        ) from None
    if bind(library, "loop_version", c_uint32)() != _hash_sources():
        raise ImportError(
            f"the compiled loop {_LIBRARY} was compiled from other C files than those "
            f"of torch_panda. Compile it again: {_install_command()}"
        )
    indices = POINTER(c_int)
    bind(library, "loop_create", c_void_p, POINTER(structs.Batch), c_int)
    bind(library, "loop_step", c_int, c_void_p, indices, c_int)
    bind(library, "loop_reset", c_int, c_void_p, indices, c_int)
    bind(library, "loop_destroy", None, c_void_p)
    for name in ("client_reset", "client_restore", "client_read"):
        bind(library, name, c_int, POINTER(structs.Batch), c_int)
    return library


def _hash_sources() -> int:
    """Hash of the C files, which ``csrc/build.py`` compiles into the library."""
    files = sorted((*_SOURCES.glob("*.c"), *_SOURCES.glob("*.h")))
    return zlib.crc32(b"".join(file.read_bytes() for file in files))


def _install_command() -> str:
    root = Path(__file__).parents[2]
    if (root / "pyproject.toml").is_file():
        return f"pip install --no-deps -e {root}"
    return "pip install --no-deps --force-reinstall --no-cache-dir torch_panda"


class Loop:
    """Owns the C threads of ``csrc/loop.c``, which step and reset the clients.

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
        n = len(clients)
        self._library = load_library()
        self._physics = physics
        self._num_threads = num_threads
        self._num_joints = len(scene.joints)
        object_joints = [k for joints in scene.object_joints for k in joints]
        c_scene = structs.Scene(
            robot=scene.robot,
            ee_link=scene.ee_link,
            num_joints=len(scene.joints),
            num_objects=len(scene.objects),
            num_object_joints=len(object_joints),
            num_markers=len(scene.markers),
            num_substeps=physics.n_substeps,
            joints=_ints(scene.joints),
            objects=_ints(scene.objects),
            object_joint_counts=_ints(map(len, scene.object_joints)),
            object_joints=_ints(object_joints),
            markers=_ints(scene.markers),
        )
        self._clients = (POINTER(structs.Client) * n)()
        # Outcome of each client's last step or reset.
        self._failures = (structs.Failure * n)()
        # A ctypes struct keeps alive the objects that it points to. It has only the
        # addresses of tensors, so `self._state` keeps the tensors alive.
        self._state = state
        self._batch = structs.Batch(
            bullet=pointer(structs.bullet_functions()),
            scene=pointer(c_scene),
            clients=self._clients,
            state=state.rows.data_ptr(),
            marker_pose=state.marker_pose.data_ptr(),
            failures=self._failures,
        )
        self._all = _ints(range(n))
        self._control: MotorControl | None = None  # control of the last step
        self._setpoint: Doubles = np.empty((0, 0))  # read by C
        self._threads: int | None = None  # address of the ``struct loop``
        self._process = os.getpid()
        for env, client in enumerate(clients):
            self.replace(env, client)

    def replace(self, env: int, client: PhysicsClient) -> None:
        """Use another client for an environment from now on."""
        self._clients[env] = pointer(client.struct)

    def step(
        self, control: MotorControl, setpoint: Doubles, envs: Sequence[int]
    ) -> bool:
        """Set the motors, advance time and read the state; see `VectorSimulation.step`.

        Ctrl-C raises when the step is done. ``envs`` must have no duplicates.

        Returns:
            Whether a state is not finite.
        """
        if control is not self._control:
            control.check(self._num_joints)
            self._batch.control = pointer(self._convert(control))
            self._control = control
            self._setpoint = np.empty((len(self._clients), control.setpoint_dim))
            self._batch.setpoint = self._setpoint.ctypes.data
        # An assignment would broadcast other shapes.
        if setpoint.shape != self._setpoint.shape:
            raise ValueError(
                f"the setpoint must have shape {self._setpoint.shape}, got "
                f"{setpoint.shape}"
            )
        self._setpoint[:] = setpoint
        self._start()
        chosen = self._all if len(envs) == len(self._all) else _ints(envs)
        if not self._library.loop_step(self._threads, chosen, len(envs)):
            return False
        self._raise_first_error(envs)
        return True

    def reset(self, envs: Sequence[int]) -> None:
        """Move bodies to the start of an episode; see `VectorSimulation.reset`."""
        self._start()
        if self._library.loop_reset(self._threads, _ints(envs), len(envs)):
            self._raise_first_error(envs)

    def reset_one(self, env: int) -> None:
        """Reset one client in the calling thread; see `VectorSimulation.reset`."""
        self._check(env, self._library.client_reset(self._batch, env))

    def restore(self, env: int) -> None:
        """Move bodies to where they were built, and restore the broad phase."""
        self._check(env, self._library.client_restore(self._batch, env))

    def read(self, env: int) -> None:
        """Copy the state of a client into the tensors."""
        self._check(env, self._library.client_read(self._batch, env))

    def close(self) -> None:
        """End the threads. Closing again does nothing."""
        # Ctrl-C raises after `loop_destroy` has freed the threads, so forget them
        # before.
        threads, self._threads = self._threads, None
        # A forked child has none of its parent's threads.
        if threads is not None and self._process == os.getpid():
            self._library.loop_destroy(threads)

    def _start(self) -> None:
        """Start the threads, unless this process has started them already."""
        if self._threads is not None and self._process == os.getpid():
            return
        self._process = os.getpid()
        self._threads = self._library.loop_create(self._batch, self._num_threads)
        if self._threads is None:
            raise MemoryError

    def _convert(self, control: MotorControl) -> structs.Control:
        return structs.Control(
            ik_link=-1 if control.ik_link is None else control.ik_link,
            num_arm_joints=control.num_arm_joints,
            setpoint_size=control.setpoint_dim,
            # Setpoints contain the orientation unless the control fixes it.
            has_orientation=control.ik_orientation is None,
            arm_mode=structs.ARM_MODES[control.arm_mode],
            ik_iterations=self._physics.ik_iterations,
            orientation=control.ik_orientation or (),
            position_gain=self._physics.position_gain,
            velocity_gain=VELOCITY_GAIN,
            forces=doubles(control.forces),
            ik_damping=doubles([self._physics.ik_damping] * len(control.forces)),
        )

    def _raise_first_error(self, envs: Sequence[int]) -> None:
        """Raise the error of the first client that failed in the last call."""
        for env in sorted(envs):
            if self._failures[env].expected:
                error = self._error(env)
                raise WorkerError(env, error) from error

    def _check(self, env: int, succeeded: int) -> None:
        """Raise the error of a client if its last command failed."""
        if not succeeded:
            raise self._error(env)

    def _error(self, env: int) -> BulletError:
        """The error of a client whose last command failed."""
        failure = self._failures[env]
        if failure.expected == structs.CLIENT_CLOSED:
            return client_closed()
        code = None if failure.answer == structs.NO_ANSWER else failure.answer
        return refusal(failure.action.decode(), code, failure.expected)


def _ints(values: Iterable[int]) -> "Array[c_int]":
    """A C array of integers."""
    values = tuple(values)
    return (c_int * len(values))(*values)
