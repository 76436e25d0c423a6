"""The state of all clients of a simulation, in tensors."""

import numpy as np
import torch

from torch_panda.bullet.client import PhysicsClient
from torch_panda.bullet.euler import euler_angles
from torch_panda.bullet.scene import Scene
from torch_panda.checks import all_finite


class SimulationState:
    """Tensors with the state of every client, which steps and resets overwrite.

    All tensors are float64, on the CPU and in the world frame. Positions refer to
    centres of mass.

    Args:
        scene: Body ids of the scene, the same in every client.
        num_envs: Number of clients.

    Attributes:
        joint_position: (num_envs, n_joints) [rad] or [m].
        joint_velocity: (num_envs, n_joints) [rad/s] or [m/s].
        ee_position: (num_envs, 3) [m].
        ee_velocity: (num_envs, 3) [m/s].
        ee_state: (num_envs, 6), position and velocity.
        ee_orientation: (num_envs, 4), quaternion xyzw.
        object_pose: (num_envs, n_objects, 7), position [m] and quaternion xyzw.
        object_state: (num_envs, n_objects, 12), position [m], Euler angles [rad] and
            velocity.
        object_velocity: (num_envs, n_objects, 6), linear [m/s] and angular [rad/s].
        object_euler: (num_envs, n_objects, 3), roll, pitch and yaw [rad]. Every step
            and every reset computes them from the quaternions.
        object_joint_position: (num_envs, n_object_joints) [rad] or [m], the joints of
            all objects, in the order of the objects.
        object_joint_velocity: (num_envs, n_object_joints) [rad/s] or [m/s].
        marker_pose: (num_envs, n_markers, 7), poses to which a reset moves the markers.
        ee_column: Column of ``rows`` at which ``ee_state`` begins.
        rows: (num_envs, k), contiguous. All tensors except ``marker_pose`` are views of
            ``rows``. Their order is that of ``client_row`` in ``client.c``.
    """

    def __init__(self, scene: Scene, num_envs: int) -> None:
        n_joints, n_objects = len(scene.joints), len(scene.objects)
        self._scene = scene
        # Objects with joints: body id, joint indices, and columns in the tensors.
        self._jointed_objects: list[tuple[int, tuple[int, ...], slice]] = []
        n_object_joints = 0
        for body, joints in zip(scene.objects, scene.object_joints, strict=True):
            if joints:
                columns = slice(n_object_joints, n_object_joints + len(joints))
                self._jointed_objects.append((body, joints, columns))
                n_object_joints += len(joints)
        arm = (n_joints, n_joints, 3, 3, 4)
        sizes = (*arm, 7 * n_objects, n_object_joints, n_object_joints, 12 * n_objects)
        # One tensor, so that one operation checks whether all numbers are finite.
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
        self.ee_column = 2 * n_joints
        self.ee_state = self.rows[:, self.ee_column : self.ee_column + 6]
        self.object_pose = object_pose.unflatten(1, (n_objects, 7))
        self.object_state = object_state.unflatten(1, (n_objects, 12))
        self.object_euler = self.object_state[..., 3:6]
        self.object_velocity = self.object_state[..., 6:]
        self.marker_pose = torch.zeros(
            num_envs, len(scene.markers), 7, dtype=torch.float64, device="cpu"
        )
        # Views of the same memory as numpy arrays, for `read`, because indexing arrays
        # is faster than indexing tensors.
        ends = np.cumsum(sizes)[:-1]
        self._parts = [np.split(row, ends) for row in self.rows.numpy()]

    def diverged(self) -> list[int]:
        """Indices of the clients whose state is not finite."""
        if all_finite(self.rows):
            return []
        return (~self.rows.isfinite()).any(dim=1).nonzero().flatten().tolist()

    def place_bodies(self, env: int, client: PhysicsClient) -> None:
        """Move the bodies of a client to the state in the tensors."""
        scene = self._scene
        positions = self.joint_position[env].tolist()
        velocities = self.joint_velocity[env].tolist()
        # One by one and in panda-gym's order, because the state of Bullet's broad phase
        # depends on the order.
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
        for body, joints, columns in self._jointed_objects:
            client.set_joints(body, joints, positions[columns], velocities[columns])

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
        for body, _, columns in self._jointed_objects:
            state = client.state(body)
            object_joints[columns] = state.joint_positions
            object_speeds[columns] = state.joint_velocities
