"""-v1 against panda-gym 1.1.0 and -v3 against 3.0.7, bit for bit.

Every -v3 id is compared, with rewards of both types. An id with dense rewards has the
physics of the other (`test_suite.test_reward_types_share_their_physics_and_ends`).
"""

import copy

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import torch_panda
from tests.envs import record_panda_gym_1_1_0 as old
from tests.ids import PHYSICS_IDS
from tests.panda_gym_reference import make_reference, start

# Our ids that panda-gym has registered; the reference imports panda-gym.
V3_IDS = [env_id for env_id in PHYSICS_IDS if env_id in gymnasium.registry]
STEPS = 60
EPISODES = 3
KEYS = ("observation", "achieved_goal", "desired_goal")


def choose_action(env_id, observation, rng, size):
    """Random actions, or actions towards the object; often out of range."""
    action = rng.normal(size=size) * 1.5
    if "Joints" in env_id:
        # Bend down onto the table.
        action[1] += 2.0
    elif len(observation) > 7 and rng.random() < 0.8:
        first = size - 3 + 6  # with a gripper, the robot's part has one more entry
        towards = observation[first : first + 3] - observation[:3]
        action[:3] = towards * 30 + rng.normal(size=3) * 0.3
    return action.astype(np.float32)


def choose_actions(env_id, observation, rngs, size):
    """Actions of all environments, each with its own random generator."""
    rows = zip(observation.numpy(), rngs, strict=True)
    actions = [choose_action(env_id, row, rng, size) for row, rng in rows]
    return torch.from_numpy(np.stack(actions))


def had_contact(reference):
    sim = reference.sim
    names = ("object", "object1", "object2", "table")
    bodies = [sim._bodies_idx[name] for name in names if name in sim._bodies_idx]
    robot = sim._bodies_idx["panda"]
    return any(sim.physics_client.getContactPoints(robot, body) for body in bodies)


def make_v1(task, **options):
    """The -v1 environment, with 1.1.0's goals in Slide, which are not the paper's."""
    if task != "Slide":
        return torch_panda.make(f"Panda{task}-v1", **options)
    return torch_panda.RobotTaskEnv(
        robot=torch_panda.Panda(block_gripper=True),
        task=torch_panda.Slide(
            goal_xy_range=0.3,
            goal_x_offset=0.4,
            table_length=1.4,
            table_x_offset=-0.1,
        ),
        **options,
    )


def test_all_ids_of_panda_gym_are_compared():
    assert len(V3_IDS) == 12


@pytest.mark.parametrize("task", old.TASKS)
def test_v1_equals_panda_gym_1_1_0(task):
    with np.load(old.FILE) as file:
        recorded = {
            key.removeprefix(f"{task}/"): torch.from_numpy(file[key])
            for key in file.files
            if key.startswith(f"{task}/")
        }
    episodes, steps, _ = recorded["action"].shape
    assert episodes >= 4
    touched, grasped = (recorded[key].sum(1) for key in ("touched", "grasped"))
    if task != "Reach":  # Reach has no object; the hand only presses on the table
        assert touched.min() >= 9
    if task in ("PickAndPlace", "Stack"):
        assert grasped.min() >= 4
    keys = ["observation", "achieved_goal"]
    if task != "Stack":  # -v1 has the paper's success for Stack, which 1.1.0 has not
        keys += ["reward", "success"]
    differing = set()
    with make_v1(task, num_envs=episodes, seed=3) as env:
        state = {
            "object_pose": recorded["object_pose"],
            "desired_goal": recorded["goal"],
        }
        td = env.reset(TensorDict(state, [episodes]), set_state=True)
        assert torch.equal(td["observation"], recorded["start"])
        for step in range(steps):
            td = env.step(td.set("action", recorded["action"][:, step]))["next"]
            for key in keys:
                expected = recorded[key][:, step].reshape(td[key].shape)
                unequal = (td[key].double() != expected.double()).any(-1)
                differing.update(unequal.nonzero().flatten().tolist())
    assert not differing


def dense_reward(reference):
    """The reward of panda-gym's id with dense rewards in the present state."""
    task = reference.task
    before, task.reward_type = task.reward_type, "dense"
    reward = task.compute_reward(task.get_achieved_goal(), task.get_goal(), {})
    task.reward_type = before
    return float(reward)


def set_table_friction(reference, friction):
    sim = reference.sim
    table = sim._bodies_idx["table"]
    sim.physics_client.changeDynamics(table, -1, lateralFriction=friction)


def play_reference(env_id):
    """Play panda-gym's episodes.

    Returns:
        The start as a state, the results of all steps, and the number of contacts.
    """
    references = [make_reference(env_id.replace("-v1", "-v3")) for _ in range(EPISODES)]
    if env_id.endswith("-v1"):
        for reference in references:
            set_table_friction(reference, 0.1)
    rngs = [np.random.default_rng(k) for k in range(EPISODES)]
    starts = [start(reference, seed=k) for k, reference in enumerate(references)]
    observations, poses, goals = zip(*starts, strict=True)
    state = {"object_pose": np.stack(poses), "desired_goal": np.stack(goals)}
    size = references[0].action_space.shape[0]
    steps, contacts = [(observations, {})], 0
    for _ in range(STEPS):
        actions = [
            choose_action(env_id, observation["observation"], rng, size)
            for observation, rng in zip(observations, rngs, strict=True)
        ]
        results = [
            r.step(action) for r, action in zip(references, actions, strict=True)
        ]
        observations = [result[0] for result in results]
        numbers = {
            "action": torch.from_numpy(np.stack(actions)),
            "reward": torch.tensor([[result[1]] for result in results]).float(),
            "dense": torch.tensor([[dense_reward(r)] for r in references]).float(),
            "terminated": torch.tensor([[result[2]] for result in results]),
        }
        steps.append((observations, numbers))
        contacts += sum(map(had_contact, references))
    for reference in references:
        reference.close()
    return TensorDict(state, [EPISODES]), steps, contacts


# Flip came after 1.1.0: its -v1 has the cube of 3.0.7 on the table of 1.1.0.
@pytest.mark.parametrize("env_id", [*V3_IDS, "PandaFlip-v1", "PandaFlipJoints-v1"])
def test_equals_panda_gym(env_id):
    state, steps, contacts = play_reference(env_id)
    with torch_panda.make(env_id, num_envs=EPISODES, seed=3) as env:
        dense_task = copy.copy(env.task)
        dense_task.reward_type = "dense"
        ours = env.reset(state, set_state=True)
        for step, (observations, theirs) in enumerate(steps):
            if theirs:
                ours = env.step(ours.set("action", theirs["action"]))["next"]
                assert torch.equal(ours["reward"], theirs["reward"])
                goals = ours["achieved_goal"], ours["desired_goal"]
                # panda-gym computes the distance to the float64 goal, and we to the
                # float32 goal that both return: a dense reward may differ in its last
                # bits.
                dense = dense_task.compute_reward(*goals)
                torch.testing.assert_close(dense, theirs["dense"], rtol=0.0, atol=1e-6)
                if env_id.endswith("-v3"):
                    assert torch.equal(ours["terminated"], theirs["terminated"])
                assert torch.equal(ours["success"], theirs["terminated"])
            for key in KEYS:
                expected = np.stack([observation[key] for observation in observations])
                assert np.array_equal(ours[key].numpy(), expected), (key, step)
    if env_id != "PandaReach-v3":
        assert contacts > 10, "the test must touch something"
