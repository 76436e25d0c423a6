"""The state of many copies of one scene, in tensors."""

import numpy as np
import torch

from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.euler import euler_angles
from torch_panda.bullet.scene import Scene
from torch_panda.checks import all_finite


class SceneState:
    """What `VectorSimulation` knows of its clients, and the way from and to a client.

    Args:
        scene: what the clients hold.
        num_envs: number of clients.

    The tensors are attributes of the same names as there.

    Attributes:
        rows: (num_envs, k) float64 and contiguous. All but ``marker_pose`` are parts of
            it, in the order of ``client_row`` in ``client.c``.
    """

    def __init__(self, scene: Scene, num_envs: int) -> None:
        n_joints, n_objects = len(scene.joints), len(scene.objects)
        self._scene = scene
        # Objects that have joints: their ids, joints, and where in the tensors.
        self._jointed_objects: list[tuple[int, tuple[int, ...], slice]] = []
        n_more = 0
        for body, joints in zip(scene.objects, scene.object_joints, strict=True):
            if joints:
                own = slice(n_more, n_more + len(joints))
                self._jointed_objects.append((body, joints, own))
                n_more += len(joints)
        arm = (n_joints, n_joints, 3, 3, 4)
        sizes = (*arm, 7 * n_objects, n_more, n_more, 12 * n_objects)
        # In one tensor, which one check finds finite or not.
        self.rows = torch.zeros(num_envs, sum(sizes), dtype=torch.float64, device="cpu")
        (
            self.joint_position,
            self.joint_velocity,
            self.ee_position,
            self.ee_velocity,
            self.ee_orientation,
            object_pose,
            self.object_joint_position,
            self.object_joint_velocity,
            object_state,
        ) = self.rows.split(sizes, dim=1)
        self.ee_state = self.rows[:, 2 * n_joints : 2 * n_joints + 6]
        self.object_pose = object_pose.unflatten(1, (n_objects, 7))
        self.object_state = object_state.unflatten(1, (n_objects, 12))
        self.object_euler = self.object_state[..., 3:6]
        self.object_velocity = self.object_state[..., 6:]
        self.marker_pose = torch.zeros(
            num_envs, len(scene.markers), 7, dtype=torch.float64, device="cpu"
        )
        # The same memory, part by part, for `read`: rows of tensors take longer.
        ends = np.cumsum(sizes)[:-1]
        self._parts = [np.split(row, ends) for row in self.rows.numpy()]

    def diverged(self) -> list[int]:
        """The clients whose state is not finite."""
        if all_finite(self.rows):
            return []
        return (~self.rows.isfinite()).any(dim=1).nonzero().flatten().tolist()

    def place(self, env: int, client: PhysicsClient) -> None:
        """Put robot, markers and objects of a client where the tensors say."""
        scene = self._scene
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

    def read(self, env: int, client: PhysicsClient) -> None:
        """Copy the state of a client into the tensors."""
        scene = self._scene
        joints, speeds, ee_position, ee_velocity, ee_orientation, *objects = (
            self._parts[env]
        )
        poses, object_joints, object_speeds, states = objects
        state = client.state(scene.robot, link_velocities=True)
        joints[:] = state.joint_positions
        speeds[:] = state.joint_velocities
        pose = state.link_pose(scene.ee_link)
        ee_position[:], ee_orientation[:] = pose[:3], pose[3:]
        ee_velocity[:] = state.link_velocity(scene.ee_link)[:3]
        for k, body in enumerate(scene.objects):
            state = client.state(body)
            pose = poses[7 * k : 7 * k + 7]
            pose[:] = state.base_pose
            angles = euler_angles(*pose[3:].tolist())
            observed = (*pose[:3], *angles, *state.base_velocity)
            states[12 * k : 12 * k + 12] = observed
        for body, _, own in self._jointed_objects:
            state = client.state(body)
            object_joints[own] = state.joint_positions
            object_speeds[own] = state.joint_velocities
