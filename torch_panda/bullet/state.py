"""The state of all clients of a simulation, in tensors."""

import torch

from torch_panda.bullet.scene import Scene


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
        object_position: (num_envs, n_objects, 3) [m].
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
            ``rows``. Their order is that of ``client_row`` in ``csrc/client.c``.
    """

    def __init__(self, scene: Scene, num_envs: int) -> None:
        n_joints, n_objects = len(scene.joints), len(scene.objects)
        n_object_joints = sum(map(len, scene.object_joints))
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
        self.object_position = self.object_pose[..., :3]
        self.object_state = object_state.unflatten(1, (n_objects, 12))
        self.object_euler = self.object_state[..., 3:6]
        self.object_velocity = self.object_state[..., 6:]
        self.marker_pose = torch.zeros(
            num_envs, len(scene.markers), 7, dtype=torch.float64, device="cpu"
        )
