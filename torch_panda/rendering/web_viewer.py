"""A viewer in the browser that shows episodes live and can go back to earlier steps.

This module needs the extra ``viewer``.
"""

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import viser
from torch import Tensor
from typing_extensions import Self

from torch_panda.bullet import PhysicsClient, VectorSimulation
from torch_panda.checks import check_instance
from torch_panda.rendering.camera import Camera
from torch_panda.rendering.web_access import (
    WILDCARDS,
    allowed_names,
    restricted_servers,
)
from torch_panda.rendering.web_bodies import WebBodies

POSITION_SIZE = 3  # numbers in a position
ARROW_LENGTH = 0.005  # length of an arrow per newton of contact force [m/N]
LONGEST_ARROW = 0.12  # [m]


class Frame(NamedTuple):
    """State of an environment at one step, which the page shows (`WebBodies.show`).

    Attributes:
        joint_position: Positions of the robot's joints, then of the objects' joints.
        object_pose: Poses of the objects.
        marker_pose: Poses of the markers.
        forces: Contact points [m] and forces [N] (n, 2, 3); see `read_forces`.
        status: Text beside the scene; see `describe`.
    """

    joint_position: npt.NDArray[np.float64]
    object_pose: npt.NDArray[np.float64]
    marker_pose: npt.NDArray[np.float64]
    forces: npt.NDArray[np.float64]
    status: str


class WebViewer:
    """Serves a page that shows one environment of a simulation.

    `RobotTaskEnv.open_viewer` makes one. Call `update` after each reset and step, in
    the thread that steps. The page then shows the new state. Its slider goes back to
    earlier steps of the episode.

    Args:
        simulation: The simulation whose state is shown.
        observe: Function that returns ``step_count``, ``success`` (num_envs, 1),
            ``achieved_goal`` and ``desired_goal`` (num_envs, goal_dim).
        exclusive: Function that returns a context manager in which no other thread can
            use the simulation.
        title: Title of the page.
        camera: See `RobotTaskEnv.open_viewer`, as for the following arguments.
        host: Address of the server.
        port: Port of the server.
        allowed_hosts: Names under which browsers may reach the server.
    """

    def __init__(
        self,
        simulation: VectorSimulation,
        observe: Callable[[], dict[str, Tensor]],
        *,
        exclusive: Callable[[], AbstractContextManager[None]],
        title: str,
        camera: Camera,
        host: str,
        port: int,
        allowed_hosts: Sequence[str],
    ) -> None:
        check_instance("camera", camera, Camera)
        self._simulation, self._observe, self._title = simulation, observe, title
        self._exclusive = exclusive
        self._episodes: list[list[Frame]] = [[] for _ in range(simulation.num_envs)]
        self._env = 0
        # Callbacks of the page's controls run in threads of viser.
        self._lock = threading.RLock()
        self._resumed = threading.Event()
        self._resumed.set()
        with ExitStack() as on_error:
            with restricted_servers(allowed_names(host, allowed_hosts)):
                self._server = server = viser.ViserServer(
                    host=host, port=port, label=title, verbose=False
                )
                on_error.callback(server.stop)
            self._bodies = WebBodies(server, simulation.clients[0], simulation.scene)
            on_error.pop_all()
        server.initial_camera.look_at = camera.target
        server.initial_camera.position = eye(camera)
        gui = server.gui
        self._status = gui.add_markdown("waiting for the first step")
        self._note = gui.add_markdown("")
        self._chosen = gui.add_slider(
            "environment", 0, max(simulation.num_envs - 1, 1), 1, 0,
            disabled=simulation.num_envs == 1,
        )  # fmt: skip
        self._step = gui.add_slider("step", 0, 1, 1, 0)  # `update` raises the maximum
        self._pause = gui.add_checkbox("pause", False)
        self._contacts = gui.add_checkbox("contacts", True)
        self._chosen.on_update(self._choose)
        self._step.on_update(self._go_to)
        self._pause.on_update(self._set_paused)
        self._contacts.on_update(lambda _: self._show())

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self._server.get_host()
        name = "localhost" if host in WILDCARDS else host
        if ":" in name:  # an IPv6 address
            name = f"[{name}]"
        return f"http://{name}:{self._server.get_port()}"

    @property
    def paused(self) -> bool:
        """Whether the page is paused at a step."""
        return not self._resumed.is_set()

    def update(self) -> None:
        """Record the state of all environments; unless paused, show the chosen one.

        At step 0 of an environment, its recording starts again.

        Raises:
            BulletError: The environment is closed or needs a reset, or another thread
                is using it.
        """
        simulation = self._simulation
        envs = range(simulation.num_envs)
        forces: list[npt.NDArray[np.float64]] = [np.zeros((0, 2, 3)) for _ in envs]

        def read_env_forces(env: int) -> None:
            forces[env] = read_forces(simulation.clients[env], simulation)

        with self._exclusive(), self._lock:
            now = self._observe()
            steps = now["step_count"].flatten().tolist()
            simulation.run(read_env_forces, [env for env in envs if steps[env] > 0])
            for env in envs:
                if steps[env] == 0:
                    self._episodes[env].clear()
                self._episodes[env].append(
                    Frame(
                        np.concatenate(
                            (
                                simulation.joint_position[env],
                                simulation.object_joint_position[env],
                            )
                        ),
                        simulation.object_pose[env].numpy().copy(),
                        simulation.marker_pose[env].numpy().copy(),
                        forces[env],
                        describe(steps[env], {key: x[env] for key, x in now.items()}),
                    )
                )
            longest = max(map(len, self._episodes)) - 1
            self._step.max = max(self._step.max, longest)
            if not self.paused:
                self._step.value = len(self._episodes[self._env]) - 1
                self._show()

    def wait(self, timeout: float | None = None) -> None:
        """Wait while the page is paused, at most ``timeout`` [s]."""
        self._resumed.wait(timeout)

    def write(self, note: str) -> None:
        """Show a line of Markdown beside the scene, for example the policy's name."""
        self._note.content = note

    def close(self) -> None:
        """Stop the server. Closing again does nothing."""
        self._resumed.set()
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- the page's controls -----------------------------------------------------

    def _choose(self, event: Any) -> None:  # noqa: ANN401 (viser's)
        with self._lock:
            self._env = _clamped(self._chosen.value, len(self._episodes))
            if not self.paused:
                self._step.value = max(len(self._episodes[self._env]) - 1, 0)
            self._show()

    def _go_to(self, event: Any) -> None:  # noqa: ANN401 (viser's)
        if event.client is not None:  # a person moved the slider, not `update`
            self._pause.value = True
            self._show()

    def _set_paused(self, event: Any) -> None:  # noqa: ANN401 (viser's)
        if self._pause.value:
            self._resumed.clear()
        else:
            self._resumed.set()

    def _show(self) -> None:
        """Show the chosen step of the chosen environment."""
        with self._lock:
            episode = self._episodes[self._env]
            if not episode:
                return
            frame = episode[_clamped(self._step.value, len(episode))]
            number = f", environment {self._env}" if len(self._episodes) > 1 else ""
            self._status.content = f"**{self._title}**{number}\n\n{frame.status}"
            forces = frame.forces if self._contacts.value else frame.forces[:0]
            with self._server.atomic():
                self._bodies.show(*frame[:3], arrows(forces))


def _clamped(index: int, count: int) -> int:
    """Limit an index that a browser sent to the range from 0 to ``count`` - 1."""
    return max(0, min(index, count - 1))


def read_forces(
    client: PhysicsClient, simulation: VectorSimulation
) -> npt.NDArray[np.float64]:
    """Contact points [m] and forces [N] of the last step, (n, 2, 3).

    The force acts on the object if the contact has one, otherwise on the robot.
    Contacts of neither are left out.
    """
    scene = simulation.scene
    rank = {body: 2 for body in scene.objects} | {scene.robot: 1}
    forces = []
    for contact in client.contact_points():
        if rank.get(contact.body_a, 0) < rank.get(contact.body_b, 0):
            contact = contact.swapped()
        if contact.body_a in rank and contact.normal_force > 0:
            forces.append((contact.position_on_a, contact.force_on_a))
    return np.array(forces, dtype=float).reshape(-1, 2, POSITION_SIZE)


def arrows(forces: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Starts and ends of arrows [m] for points and forces, (n, 2, 3) each."""
    point, force = forces[:, 0], forces[:, 1]
    size = np.linalg.norm(force, axis=1, keepdims=True)
    length = np.minimum(ARROW_LENGTH * size, LONGEST_ARROW)
    return np.stack((point, point + length * force / np.maximum(size, 1e-9)), axis=1)


def describe(step: int, state: dict[str, Tensor]) -> str:
    """Step, success and distance from the goal, in Markdown."""
    lines = [f"step {step}", "**success**" if state["success"] else "no success yet"]
    difference = (state["achieved_goal"] - state["desired_goal"]).double()
    if len(difference) % POSITION_SIZE == 0:  # a position per object
        distance = difference.reshape(-1, POSITION_SIZE).norm(dim=1).max()
        lines.append(f"{100 * distance:.1f} cm from the goal")
    return "  \n".join(lines)


def eye(camera: Camera) -> tuple[float, float, float]:
    """Position of a camera, world frame [m]; see `Camera`."""
    yaw, pitch = np.radians(camera.yaw), np.radians(camera.pitch)
    x, y, z = camera.target
    flat = camera.distance * np.cos(pitch)
    return (
        x + flat * np.sin(yaw),
        y - flat * np.cos(yaw),
        z - camera.distance * np.sin(pitch),
    )
