"""A task and a robot of your own: a Kuka arm pushes a ball to a marker.

    python examples/own_task.py

The guide torch_panda/README.md explains each part. The registered id works wherever a
shipped id does: in `make`, in Gymnasium and in the commands.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import torch_panda
from torch_panda.bullet import PhysicsClient, Sphere, VectorSimulation
from torch_panda.tasks import Bodies, create_table, object_observation

RADIUS = 0.03  # of the ball [m]


class PushBall(torch_panda.Task):
    """Push a ball to a point of the table."""

    goal_dim, observation_dim = 3, 12

    def build(self, client: PhysicsClient) -> Bodies:
        """Build the table, the ball, and a marker that shows the goal."""
        create_table(client)
        center = (0.0, 0.0, RADIUS)
        ball = client.create_sphere(RADIUS, mass=0.5, position=center)
        marker = client.create_marker(center, Sphere(RADIUS))
        return Bodies(objects=(ball,), markers=(marker,))

    def sample_goal(self, rng: np.random.Generator) -> Sequence[float]:
        """Draw a position of the ball on the table [m]."""
        return (*rng.uniform(-0.15, 0.15, size=2), RADIUS)

    def sample_objects(self, rng: np.random.Generator) -> Sequence[Sequence[float]]:
        """Draw the ball's start: position [m] and quaternion xyzw."""
        return ((*rng.uniform(-0.1, 0.1, size=2), RADIUS, 0, 0, 0, 1),)

    def observation(self, simulation: VectorSimulation) -> Tensor:
        """The ball's position, Euler angles and velocities: (num_envs, 12)."""
        return object_observation(simulation, 0)

    def achieved_goal(self, simulation: VectorSimulation) -> Tensor:
        """The ball's position: (num_envs, 3)."""
        return simulation.object_pose[:, 0, :3]

    # The remaining methods are optional.

    def randomize(
        self, client: PhysicsClient, bodies: Bodies, rng: np.random.Generator
    ) -> None:
        """Draw the ball's mass before every episode of an environment."""
        client.set_dynamics(bodies.objects[0], mass=rng.uniform(0.2, 1.0))

    def failure(self, simulation: VectorSimulation) -> Tensor:
        """Whether the ball fell off the table: (num_envs, 1). Ends the episode."""
        return simulation.object_pose[:, 0, 2:3] < 0

    def extra_observation(self, simulation: VectorSimulation) -> dict[str, Tensor]:
        """More observations, each under its own key."""
        return {"hand_orientation": simulation.ee_orientation}


def make_arm() -> torch_panda.Robot:
    """A KUKA iiwa: its URDF and the numbers that a URDF does not give."""
    return torch_panda.Robot(
        urdf="kuka_iiwa/model.urdf",
        neutral_joint_position=(0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0),  # [rad]
        effort_limits=(200.0,) * 7,  # [N m]
        ee_link=6,
        ee_orientation=(0.0, 1.0, 0.0, 0.0),  # quaternion xyzw
    )


torch_panda.register("PushBall-v0", robot=make_arm, task=PushBall, max_episode_steps=30)


def main() -> Tensor:
    """Send the hand to the balls; return how far they moved, (num_envs,) [m]."""
    with torch_panda.make("PushBall-v0", num_envs=4, seed=0) as env:
        td = env.reset()
        start = td["achieved_goal"]
        while not td["done"].any():
            to_ball = td["achieved_goal"] - td["observation"][:, :3]
            td = env.step(td.set("action", 5 * to_ball))["next"]  # type: ignore[assignment]
        distance = torch.linalg.vector_norm(td["achieved_goal"] - start, dim=-1)
    for env_index, moved in enumerate(distance.tolist()):
        print(f"environment {env_index}: the ball moved by {100 * moved:.1f} cm")
    return distance


if __name__ == "__main__":
    main()
