"""Evaluations: the episodes that run, and the results."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import RandomPolicy

import torch_panda
from torch_panda.experts import make_expert
from torch_panda.learning.evaluation import _summarize, wilson_interval


def test_a_policy_that_succeeds_has_a_success_rate_of_1():
    policy = torch_panda.load_policy("PandaReach-v1")
    options = {"episodes": 8, "num_envs": 4, "seed": 1}
    result = torch_panda.evaluate(policy, "PandaReach-v1", **options)
    assert result.success.shape == (8,)
    assert result.success.dtype == torch.bool
    assert result.success_rate == 1.0
    assert result.interval == wilson_interval(8, 8)
    assert result.mean_return == pytest.approx(float(result.returns.mean()))
    assert -5 < result.mean_return < 0
    assert (result.lengths == 50).all()
    assert "8 episodes, success_rate=1.000" in repr(result)


def test_a_policy_that_does_nothing_succeeds_only_at_the_start():
    still = TensorDictModule(lambda goal: 0 * goal, ["desired_goal"], ["action"])
    options = {"episodes": 12, "num_envs": 6, "seed": 3}
    result = torch_panda.evaluate(still, "PandaReach-v1", **options)
    assert result.success_rate < 0.5
    # The hand stays where it starts.
    assert torch.equal(result.success, result.at_start)
    assert torch.equal(result.success, result.ever)
    assert torch.equal(result.returns, torch.where(result.success, 0.0, -50.0))


def test_episodes_of_v3_end_at_success():
    expert = make_expert("PandaReach-v3")
    result = torch_panda.evaluate(expert, "PandaReach-v3", episodes=10, num_envs=5)
    assert result.success_rate == 1.0
    assert torch.equal(result.ever, result.success)
    assert 1 <= result.lengths.min() < result.lengths.max() < 50
    assert result.mean_length == float(result.lengths.double().mean())
    # Every step but the last one costs 1.
    assert torch.equal(result.returns, 1.0 - result.lengths)


def test_a_seed_fixes_the_episodes():
    """Without a seed, they are those of the seed 1,000."""
    policy = torch_panda.load_policy("PandaReach-v1")
    options = ({"seed": 1_000}, {}, {"seed": 1})
    first, again, other = (
        torch_panda.evaluate(policy, "PandaReachDense-v1", episodes=2, **seed)
        for seed in options
    )
    assert torch.equal(first.returns, again.returns)
    assert not torch.equal(first.returns, other.returns)


def test_success_is_that_of_the_last_step():
    flags = [[0, 1, 0], [0, 0, 1], [1, 0, 1]]
    success = torch.tensor(flags, dtype=torch.bool).unsqueeze(-1)
    after = {"success": success, "reward": success.float() - 1}
    at_start = torch.tensor([True, False, False])[:, None, None].expand(3, 3, 1)
    rollout = TensorDict({"success": at_start, "next": after}, [3, 3])
    # The last transition of the third episode is after its end.
    result = _summarize(rollout, torch.tensor([3, 3, 2]))
    assert result.success.tolist() == [False, True, False]
    assert result.ever.tolist() == [True, True, True]
    assert result.at_start.tolist() == [True, False, False]
    assert result.returns.tolist() == [-2.0, -2.0, -1.0]
    assert result.lengths.tolist() == [3, 3, 2]


def test_the_wilson_interval_is_that_of_the_textbook():
    """For 8 successes of 10."""
    assert wilson_interval(8, 10) == pytest.approx((0.490, 0.943), abs=1e-3)


class Stay(torch.nn.Module):
    """Changes the TensorDict in place, and returns nothing."""

    def forward(self, tensordict):
        tensordict["action"] = 0 * tensordict["desired_goal"]


@pytest.mark.parametrize("tasks", ["random", "fixed"])
def test_a_function_may_be_the_policy(tasks):
    def stay(tensordict):
        return tensordict.set("action", 0 * tensordict["desired_goal"])

    module = TensorDictModule(lambda goal: 0 * goal, ["desired_goal"], ["action"])
    results = [
        torch_panda.evaluate(policy, "PandaReach-v1", episodes=5, tasks=tasks)
        for policy in (stay, module, Stay())
    ]
    for result in results[1:]:
        assert torch.equal(results[0].returns, result.returns)


def test_a_policy_in_training_mode_is_not_changed():
    norm, frozen = torch.nn.BatchNorm1d(3), torch.nn.Dropout(0.5).eval()
    network = torch.nn.Sequential(norm, torch.nn.Dropout(0.5), frozen)
    policy = TensorDictModule(network, ["desired_goal"], ["action"])
    options = {"episodes": 2, "seed": 0}
    first, second = (
        torch_panda.evaluate(policy, "PandaReachDense-v1", **options) for _ in range(2)
    )
    assert torch.equal(first.returns, second.returns)
    assert norm.num_batches_tracked == 0
    assert network.training
    assert norm.training
    assert not frozen.training


def test_options_of_make_are_passed_on():
    policy = torch_panda.load_policy("PandaReach-v1")
    options = {"task_options": {"distance_threshold": 10.0}, "physics": "fast"}
    result = torch_panda.evaluate(policy, "PandaReach-v1", episodes=4, **options)
    assert result.mean_return == 0.0
    assert result.at_start.all()


def test_fixed_tasks_are_reported_one_by_one():
    still = TensorDictModule(lambda goal: 0 * goal, ["desired_goal"], ["action"])
    options = {"episodes": 8, "tasks": "fixed", "seed": 3}
    result = torch_panda.evaluate(still, "PandaPush-v1", num_envs=4, **options)
    tasks = torch_panda.evaluation_tasks("PandaPush-v1")
    assert list(result.tasks) == list(tasks)
    assert all(len(task.success) == 2 for task in result.tasks.values())
    # The hand stays far from the object, which stays where it starts.
    assert torch.equal(result.success, result.at_start)
    for name, state in tasks.items():
        distance = (state["object_pose"][0, :3] - state["desired_goal"]).norm()
        assert result.tasks[name].success_rate == float(distance < 0.05)
    rates = [task.success_rate for task in result.tasks.values()]
    assert result.success_rate == pytest.approx(sum(rates) / 5)
    assert f"very_near={rates[0]:.3f}" in repr(result)


def test_episodes_of_a_fixed_task_differ_and_depend_on_the_seed_alone():
    env_id = "PandaReachDense-v1"
    expert = make_expert(env_id)
    options = {"episodes": 10, "tasks": "fixed"}
    few, many, other = (
        torch_panda.evaluate(expert, env_id, num_envs=num_envs, seed=seed, **options)
        for num_envs, seed in ((2, 1), (5, 1), (5, 2))
    )
    assert torch.equal(few.returns, many.returns)
    assert not torch.equal(few.returns, other.returns)
    assert len(many.tasks["far"].returns.unique()) > 1
    assert many.success_rate == 1.0


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"episodes": 0}, ValueError, "episodes must be"),
        ({"num_envs": 0}, ValueError, "num_envs must be"),
        ({"tasks": "named"}, ValueError, 'tasks must be "random" or "fixed"'),
        ({"env_id": "PandaFly-v1"}, ValueError, "unknown environment id"),
        ({"policy": "PandaReach-v1"}, TypeError, "load_policy reads one from a file"),
        ({"policy": torch.nn.Linear}, TypeError, "must be a module or a function"),
        ({"policy": lambda td: td["desired_goal"]}, TypeError, "wrap a network as"),
        ({"policy": torch.nn.Linear(6, 3)}, TypeError, "wrap a network as"),
        ({"n_envs": 4}, TypeError, "n_envs"),
    ],
)
def test_bad_arguments_of_evaluate_are_refused(arguments, error, message):
    accepted = {"policy": RandomPolicy(None), "env_id": "PandaReach-v1", "episodes": 1}
    with pytest.raises(error, match=message):
        torch_panda.evaluate(**(accepted | arguments))
