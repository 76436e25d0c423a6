"""Trained policies as files: shipped ones, those of runs, and how they act."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torch_panda
from tests.devices import DEVICES
from tests.learning.transitions import make_transitions
from torch_panda.learning.agents import (
    AGENTS,
    OFFLINE_AGENTS,
    Hyperparameters,
    find_agent,
    make_agent,
)
from torch_panda.learning.environments.spaces import read_spaces
from torch_panda.learning.files.policy_files import save_policy
from torch_panda.policies import shipped_policies

HASHES = Path(__file__).with_name("policies.json")


@pytest.fixture(scope="module")
def env():
    with torch_panda.make("PandaPickAndPlace-v1", num_envs=4, seed=0) as env:
        yield env


def save(env, path, device="cpu", **options):
    """Write the policy of a new agent, and return the agent."""
    torch.manual_seed(0)
    hp = Hyperparameters(**options)
    with torch.device(device):
        agent = find_agent(hp)(read_spaces(env), hp)
        rows = inputs(agent.spaces, 50)
        agent.normalizer.update(rows["observation"], rows["desired_goal"])
    if not hp.offline:
        agent.update(make_transitions(env, 16).to(device))
    save_policy(path, agent, "PandaPickAndPlace-v1")
    return agent


def inputs(spaces, *batch_size):
    observation = torch.randn(*batch_size, spaces.observation_size)
    goal = torch.randn(*batch_size, spaces.goal_size)
    td = TensorDict(observation=observation, desired_goal=goal)
    return td.auto_batch_size_(len(batch_size))


RECIPE = {
    **{"relative_inputs": "fine", "fine_fingers": True},
    **{"network": "layer-norm", "ema_rate": 0.1},
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "options",
    [
        *({"algo": algo, **more} for algo in AGENTS for more in ({}, RECIPE)),
        *({"algo": algo, "offline": True} for algo in OFFLINE_AGENTS),
    ],
    ids=lambda options: "-".join(map(str, options.values())),
)
def test_a_loaded_policy_acts_as_the_saved_agent(env, tmp_path, device, options):
    agent = save(env, tmp_path / "checkpoint.pt", device, **options)
    state = torch.get_rng_state()
    policy = torch_panda.load_policy(tmp_path)
    assert torch.equal(state, torch.get_rng_state())
    assert policy.env_id == "PandaPickAndPlace-v1"
    td = inputs(policy.spaces, 16)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = agent.policy.cpu()(td.clone())["action"]
    result = policy(td)
    assert torch.equal(result["action"], expected)
    assert set(result.keys()) == {"observation", "desired_goal", "action"}


def test_actions_are_the_same_under_any_exploration_type(env, tmp_path):
    save(env, tmp_path / "sac.pt", algo="sac")
    policy = torch_panda.load_policy(tmp_path / "sac.pt")
    td = inputs(policy.spaces, 16)
    expected = policy(td.clone())["action"]
    for exploration in ExplorationType:
        with set_exploration_type(exploration):
            result = policy(td.clone())["action"]
        assert torch.equal(result, expected)
        assert not result.requires_grad


def test_shipped_policies_act_on_batches_of_any_shape():
    policy = torch_panda.load_policy("PandaStack-v1")
    # In double precision: sums of another batch size round differently.
    policy, td = policy.double(), inputs(policy.spaces, 6).double()
    actions = policy(td.clone())["action"]
    assert actions.shape == (6, policy.spaces.action_size)
    grid = policy(td.reshape(2, 3))["action"]
    torch.testing.assert_close(grid.flatten(0, 1), actions)
    torch.testing.assert_close(policy(td[0])["action"], actions[0])


@pytest.mark.parametrize("env_id", shipped_policies())
def test_shipped_policies_have_the_spaces_of_their_environment(env_id):
    policy = torch_panda.load_policy(env_id)
    assert policy.env_id == env_id
    with torch_panda.make(env_id, num_envs=1) as env:
        assert replace(policy.spaces, num_envs=1) == read_spaces(env)


def test_a_policy_of_an_unregistered_id_loads(tmp_path):
    scene = {"robot": torch_panda.Panda(), "task": torch_panda.Flip()}
    options = {"relative_inputs": "coarse"}
    with torch_panda.RobotTaskEnv(**scene, num_envs=2) as env:
        agent = make_agent(env, Hyperparameters(**options))
        save_policy(tmp_path / "checkpoint.pt", agent, "Nowhere-v0")
    policy = torch_panda.load_policy(str(tmp_path))
    assert policy.env_id == "Nowhere-v0"
    assert policy(inputs(policy.spaces, 2))["action"].shape == (2, 4)


def test_the_weights_of_shipped_policies_are_the_published_ones():
    """So a change of the files' format keeps every action, bit for bit."""
    hashes = {}
    for env_id, path in shipped_policies().items():
        weights = torch.load(path)["policy"]
        content = hashlib.sha256()
        for values in (*weights["normalizer"].values(), *weights["actor"].values()):
            content.update(values.numpy().tobytes())
        hashes[env_id] = content.hexdigest()
    assert hashes == json.loads(HASHES.read_text())


LOAD = """
import sys
for name in ("tyro", "matplotlib", "imageio", "viser", "minari"):
    sys.modules[name] = None  # importing it raises
import torch_panda
policy = torch_panda.load_policy("PandaReach-v1")
print(torch_panda.evaluate(policy, "PandaReach-v1", episodes=1).success_rate)
"""


@pytest.mark.slow
def test_loading_and_evaluating_need_no_extra():
    done = subprocess.run([sys.executable, "-c", LOAD], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "1.0\n"


def test_a_folder_without_a_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"there is no file .*checkpoint\.pt"):
        torch_panda.load_policy(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"spaces": {"size": 3}}, "does not hold a policy, or is damaged"),
        ({"spaces": {"geometry": None}}, "another version .*: .*observation_size"),
        ({"policy": {}}, "its weights do not fit its hyperparameters"),
        ({"hyperparameters": {"depth": 3}}, "another version .*: .*'depth'"),
        ({"hyperparameters": {"algo": "ppo"}}, r"algo must be one of .*, got 'ppo'$"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_policy_files_of_other_versions_are_refused(tmp_path, change, message):
    content = torch.load(shipped_policies()["PandaReach-v1"]) | change
    path = tmp_path / "policy.pt"
    torch.save(content, path)
    with pytest.raises(ValueError, match=f"^{path} .*{message}"):
        torch_panda.load_policy(path)
