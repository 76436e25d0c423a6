"""Learning from demonstrations beside one's own transitions."""

import pytest
import torch
from tensordict import TensorDict

import record_demos
import torch_panda
from agents import Agent, Hyperparameters
from tests.examples.test_train import run
from train import Args, Run


@pytest.fixture
def env():
    with torch_panda.make("PandaPush-v1", num_envs=2) as env:
        yield env


def transitions(env, number):
    """Random ones, of the sizes of an environment's."""
    spec = env.observation_spec_unbatched

    def observation():
        keys = ("observation", "desired_goal")
        return {key: torch.randn(number, *spec[key].shape) for key in keys}

    flag = torch.zeros(number, 1, dtype=torch.bool)
    end = {"done": flag, "terminated": flag, "reward": torch.full((number, 1), -1.0)}
    action = torch.rand(number, *env.action_spec_unbatched.shape) * 2 - 1
    return TensorDict(
        {**observation(), "action": action, "next": {**observation(), **end}}, [number]
    )


def values(agent, batch, action):
    """What the critic gives actions, (n, 1)."""
    loss, critic = agent.loss, agent.loss.value_network
    inputs = TensorDict({"normalized": agent._normalize(batch), "action": action})
    with torch.no_grad(), loss.value_network_params.to_module(critic):
        return critic(inputs)["state_action_value"]


@pytest.mark.parametrize("q_filter", [True, False])
def test_imitates_what_the_critic_prefers_or_all(env, q_filter):
    torch.manual_seed(0)
    hp = Hyperparameters(bc_weight=3.0, q_filter=q_filter)
    agent = Agent(env, hp, max_episode_steps=50, sparse=True)
    batch, demos = transitions(env, 64), transitions(env, 32)
    with torch.no_grad():
        action = agent.policy(demos.clone())["action"]
    demonstrated = values(agent, demos, demos["action"])
    better = demonstrated > values(agent, demos, action)
    assert 0 < better.sum() < len(better)
    error = (action - demos["action"]).square()
    expected = 3 * (error * better if q_filter else error).mean()

    losses = agent.update(batch.clone(), demos.clone())
    torch.testing.assert_close(losses["loss_bc"], expected)
    assert "loss_bc" not in agent.update(batch.clone())


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_policy_comes_closer_to_demonstrations(env, algo):
    torch.manual_seed(0)
    hp = Hyperparameters(algo=algo, bc_weight=1000.0, learning_rate=1e-4)
    agent = Agent(env, hp, max_episode_steps=50, sparse=True)
    batch, demos = transitions(env, 64), transitions(env, 32)
    losses = [agent.update(batch.clone(), demos.clone()) for _ in range(19)]
    assert 0 < losses[-1]["loss_bc"] < 0.9 * losses[0]["loss_bc"]


@pytest.mark.parametrize("her_ratio", [0.0, 0.6, 1.0])
def test_demonstrations_are_given_the_goal_they_achieved(tmp_path, her_ratio):
    path = tmp_path / "demos.pt"
    record_demos.main(
        record_demos.Args("PandaSlide-v1", episodes=4, num_envs=4, out=path)
    )
    demos = TensorDict(torch.load(path), [200]).reshape(4, -1)
    final = demos["next", "achieved_goal"][:, -1]
    assert (final - demos["desired_goal"][:, -1]).norm(dim=-1).max() > 0.05  # a miss
    args = Args(
        env_id="PandaSlide-v1",
        demos=path,
        demo_ratio=0.5,
        demo_her_ratio=her_ratio,
        batch_size=2000,
    )
    training = Run(args, tmp_path)
    batch = training.demos.sample(training.num_demos)
    episode = batch["collector", "traj_ids"]
    given = (batch["desired_goal"] == final[episode]).all(-1)
    assert abs(given.double().mean() - her_ratio) < 0.1
    kept = demos["desired_goal"][:, 0][episode]
    assert (batch["desired_goal"] == kept).all(-1)[~given].all()
    assert (batch["next", "desired_goal"] == batch["desired_goal"]).all()
    reward = training.env.compute_reward(
        batch["next", "achieved_goal"], batch["desired_goal"]
    )
    torch.testing.assert_close(batch["next", "reward"], reward)
    training.close()


class StopAfter:
    """True from the n-th question on."""

    def __init__(self, number):
        self.left = number

    def __bool__(self):
        self.left -= 1
        return self.left < 0


@pytest.mark.parametrize(
    ("updates", "expected"), [(40, [12, 24, 36, 40]), (36, [12, 24, 36])]
)
def test_imitation_saves_in_between(tmp_path, updates, expected):
    path = tmp_path / "demos.pt"
    record_demos.main(record_demos.Args(episodes=4, num_envs=4, out=path))
    options = {"total_steps": 0, "pretrain_updates": updates, "eval_episodes": 2}
    args = Args(env_id="PandaPush-v1", demos=path, save_interval=12, **options)
    training = Run(args, tmp_path)
    saved = []
    training.save = lambda file: saved.append(training.pretrained) or file.touch()
    assert training.pretrain(None)
    training.close()
    assert saved == expected


@pytest.mark.parametrize("algo", ["td3", "sac"])
def test_imitation_goes_on_where_it_was_stopped(tmp_path, algo):
    path = tmp_path / "demos.pt"
    record_demos.main(record_demos.Args(episodes=4, num_envs=4, out=path))
    options = {"mirror": True, "eval_episodes": 2}
    options |= {"total_steps": 0, "pretrain_updates": 40}
    args = Args(algo=algo, env_id="PandaPush-v1", demos=path, **options)

    def weights(training):
        return {k: v.clone() for k, v in training.agent.state_dict().items()}

    whole = Run(args, tmp_path)
    before = weights(whole)
    assert whole.train()
    after = weights(whole)
    whole.close()
    changed = {key for key in after if not torch.equal(before[key], after[key])}
    actor = {key for key in after if "actor_network" in key}
    assert actor
    assert actor <= changed
    assert not any("value" in key or "normalizer" in key for key in changed)
    assert [row["step"] for row in whole.curve] == [0]

    stopped = Run(args, tmp_path)
    assert not stopped.pretrain(StopAfter(15))
    stopped.close()
    assert not stopped.curve
    resumed = Run(args, tmp_path)
    resumed.load(tmp_path / "resume.pt")
    assert resumed.pretrained == 15
    assert resumed.pretrain(StopAfter(100))
    resumed.close()
    torch.testing.assert_close(weights(resumed), after, rtol=0, atol=0)
    assert resumed.curve[0]["success"] == whole.curve[0]["success"]


def test_training_stores_demonstrations_apart(tmp_path):
    demos = tmp_path / "demos.pt"
    run("record_demos", "--env-id", "PandaPush-v1", "--episodes", 4, "--out", demos)
    arguments = [*("--env-id", "PandaPush-v1", "--demos", demos, "--num-envs", 2)]
    arguments += [*("--eval-episodes", 2, "--updates-per-step", 0.05, "--no-video")]
    arguments += [*("--total-steps", 200, "--save-interval", 100, "--batch-size", 16)]
    out = tmp_path / "run"
    run("train", *arguments, "--out", out)
    state = torch.load(out / "resume.pt")
    assert state["demos"]["_storage"]["_len"] == 200
    assert state["buffer"]["_storage"]["_len"] == 200
    assert state["agent"]["normalizer.count"] == 400

    wrong = [*arguments, "--env-id", "PandaPickAndPlace-v1", "--out", tmp_path / "no"]
    refused = run("train", *wrong, check=False)
    assert refused.returncode == 1
    assert "observation has size 18, the task's has 19" in refused.stderr
