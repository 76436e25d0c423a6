"""A user's task with all hooks and a drawer, written with public names only."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

import torch_panda
from torch_panda import Panda, Reach, RobotTaskEnv, Task
from torch_panda.tasks import Bodies, create_table

# A box on a slide along x, with a knob towards the robot.
DRAWER = """
<robot name="drawer">
  <link name="frame"/>
  <joint name="slide" type="prismatic">
    <parent link="frame"/>
    <child link="box"/>
    <axis xyz="1 0 0"/>
    <limit lower="-0.2" upper="0.1" effort="100" velocity="10"/>
  </joint>
  <link name="box">
    <inertial><mass value="0.5"/>
      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>
    <collision><geometry><box size="0.06 0.3 0.2"/></geometry></collision>
    <visual><geometry><box size="0.06 0.3 0.2"/></geometry></visual>
  </link>
</robot>
"""


class Shove(Task):
    """Shove a drawer to a position. Its friction differs between episodes."""

    goal_dim = 1
    observation_dim = 2

    def __init__(self, *, urdf=None, force=2.0, **options):
        super().__init__(**options)
        self.urdf, self.force = urdf, force

    def build(self, client):
        create_table(client)
        drawer = client.load_urdf(self.urdf, position=(0.1, 0, 0.12), fixed_base=True)
        return Bodies(objects=(drawer,))

    def sample_goal(self, rng):
        return (rng.uniform(0.03, 0.09),)

    def sample_objects(self, rng):
        return ((0.1, rng.uniform(-0.05, 0.05), 0.12, 0, 0, 0, 1),)

    def sample_object_joints(self, rng):
        return (rng.uniform(-0.03, 0.0),)

    def randomize(self, client, bodies, rng):
        friction = rng.uniform(0.5, 1.5) * self.force
        client.set_joint_friction(bodies.objects[0], 0, friction)

    def observation(self, simulation):
        position = simulation.object_joint_position
        return torch.cat((position, simulation.object_joint_velocity), dim=1)

    def achieved_goal(self, simulation):
        return simulation.object_joint_position

    def reward(self, simulation, action, achieved_goal, desired_goal):
        effort = action.square().sum(1, keepdim=True)
        return self.compute_reward(achieved_goal, desired_goal) - 0.1 * effort

    def failure(self, simulation):
        return simulation.ee_position[:, 2:] > 0.3

    def extra_observation(self, simulation):
        low = simulation.ee_position[:, 2:] < 0.05
        return {"ee_orientation": simulation.ee_orientation, "is_low": low}


ID = "Shove-v0"


@pytest.fixture(autouse=True)
def shove(tmp_path):
    file = tmp_path / "drawer.urdf"
    file.write_text(DRAWER)
    torch_panda.register(
        ID,
        robot=lambda **options: Panda(block_gripper=True, **options),
        task=lambda **options: Shove(urdf=file, **options),
        max_episode_steps=30,
    )
    yield ID


def push_forward(env):
    """Move the hand along x and return the outputs of 12 steps."""
    td, outputs = env.reset(), []
    for _ in range(12):
        action = torch.zeros(env.action_spec.shape)
        action[..., 0] = 1.0
        td = env.step(td.set("action", action))["next"]
        outputs.append(td.clone())
    return torch.stack(outputs)


def test_a_joint_of_an_object_is_state_goal_and_observation():
    with torch_panda.make(ID, num_envs=3, seed=0) as env:
        check_env_specs(env)
        seen = push_forward(env)
        assert env.max_episode_steps == 30
        state = env.get_state()
        assert state["object_joint_position"].shape == (3, 1)
        assert torch.equal(
            state["object_joint_position"].float(), seen[-1]["achieved_goal"]
        )
        assert (seen[-1]["achieved_goal"] > 0.02).all()
        assert len(state["object_pose"][:, 0, 1].unique()) == 3
        # The drawers have different frictions, so they end at different speeds.
        assert len(seen[-1]["observation"][:, -2].unique()) == 3


def test_the_hooks_of_a_task_are_called():
    with torch_panda.make(ID, num_envs=2, seed=0) as env:
        td = env.reset()
        assert not td["terminated"].any()
        action = torch.zeros(2, 3)
        action[0, 2] = 1.0
        for _ in range(8):
            td = env.step(td.set("action", action))["next"]
        goals = td["achieved_goal"], td["desired_goal"]
        effort = torch.tensor([[0.1], [0.0]])
        torch.testing.assert_close(td["reward"], env.compute_reward(*goals) - effort)
        assert td["ee_orientation"].shape == (2, 4)
        assert td["is_low"].dtype == torch.bool and not td["is_low"].any()
        assert td["terminated"].tolist() == [[True], [False]] == td["done"].tolist()
        assert not td["truncated"].any()
        td["_reset"] = td["done"]
        assert not env.reset(td)["done"].any()


def test_episodes_and_exact_states_repeat_bit_for_bit():
    with (
        torch_panda.make(ID, num_envs=3, seed=5) as env,
        torch_panda.make(ID, num_envs=2, seed=5, num_threads=1) as other,
    ):
        push_forward(env)  # leaves friction and contacts behind
        env.set_seed(5)
        first = push_forward(env)
        assert (push_forward(other) == first[:, :2]).all()
        state = env.get_state(exact=True)
        after = env.rand_step(first[-1].exclude("reward", "action"))
        # An exact state brings the friction of its episode.
        again = env.reset(state, set_state=True)
        again["action"] = after["action"]
        assert (env.step(again)["next"] == after["next"]).all()
        fork = state[[1, 1, 1]]
        again = env.reset(fork, set_state=True)
        again["action"] = after["action"][[1, 1, 1]]
        forked = env.step(again)["next"]
        assert (forked == after["next"][[1, 1, 1]]).all()


class Buffered(Reach):
    """A task that writes into the same tensors at every step, and into the action."""

    def __init__(self, **options):
        super().__init__(**options)
        self.goal, self.out = torch.zeros(2, 3), torch.zeros(2, 1)

    def achieved_goal(self, simulation):
        return self.goal.copy_(simulation.ee_position)

    def reward(self, simulation, action, achieved_goal, desired_goal):
        action.zero_()
        return self.out.copy_(-self.distance(achieved_goal, desired_goal))


def test_outputs_do_not_share_tensors_that_a_task_reuses():
    with RobotTaskEnv(
        robot=Panda(block_gripper=True), task=Buffered(), num_envs=2, seed=0
    ) as env:
        following = env.rollout(5)["next"]
        exact = env.get_state(exact=True)
        assert exact["actions"].any()
    goals = following["achieved_goal"], following["desired_goal"]
    assert len(following["reward"].unique()) == 10
    assert torch.equal(following["reward"], -env.task.distance(*goals))
