"""Gradient steps that are recorded and replayed, here without a GPU.

`Recording` stands in for a CUDA graph: it repeats the operations of a step on the same
tensors, and runs none of its Python code.
"""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.modules.distributions import continuous

from tests.learning.episodes import play
from torch_panda.learning.agents import (
    AGENTS,
    OFFLINE_AGENTS,
    make_agent,
    networks,
    recorded_step,
)
from torch_panda.learning.agents.base import Agent
from torch_panda.learning.agents.recorded_step import WARM_UP
from torch_panda.learning.agents.stacked import StackedAgents
from torch_panda.learning.offline_data import OfflineData
from torch_panda.learning.options import default_args

REPLAYS = 2
# A CUDA graph cannot record these operations: one reads a number of a tensor, the other
# makes a tensor from numbers.
ON_CPU = (
    torch.ops.aten._local_scalar_dense.default,
    torch.ops.aten.lift_fresh.default,
)


def tensors(tree):
    return [x for x in tree_leaves(tree) if isinstance(x, torch.Tensor)]


class Recording(TorchDispatchMode):
    """Records operations, and repeats them.

    Attributes:
        calls: The operations, with their arguments and results.
        before: The arguments of operations in place, by their ids, each with a copy of
            its content before the recording.
    """

    def __init__(self):
        super().__init__()
        self.calls, self.before = [], {}

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert function not in ON_CPU
        if function._schema.is_mutable:
            for x in tensors((args, kwargs)):
                self.before.setdefault(id(x), (x, x.clone()))
        result = function(*args, **(kwargs or {}))
        if function.namespace == "aten":
            self.calls.append((function, args, kwargs or {}, result))
        return result

    @torch.no_grad()
    def undo(self):
        """Give all tensors their contents from before the recording."""
        for x, content in self.before.values():
            x.copy_(content)

    @torch.no_grad()
    def replay(self):
        for function, args, kwargs, result in self.calls:
            schema = function._schema
            returns_view = any(x.alias_info is not None for x in schema.returns)
            if schema.is_mutable:
                function(*args, **kwargs)
            elif not returns_view:
                new = function(*args, **kwargs)
                for x, y in zip(tensors(result), tensors(new), strict=True):
                    x.copy_(y)


def fake_record(step, optimizer):
    random_state = torch.get_rng_state()
    with Recording() as recording:
        losses = step()
    recording.undo()
    torch.set_rng_state(random_state)

    def replay():
        recording.replay()
        return losses

    return replay


@pytest.fixture(autouse=True)
def _fake_gpu(monkeypatch):
    monkeypatch.setattr(networks, "HIDDEN_SIZE", 32)
    monkeypatch.setattr(recorded_step, "record", fake_record)
    monkeypatch.setattr(recorded_step, "take_aside", lambda step: step())
    # torchrl checks the arguments of distributions only outside of recordings.
    name = "safe_is_current_stream_capturing"
    monkeypatch.setattr(continuous, name, lambda: True)


def make_batches(env, data, agent, number):
    """Arguments of ``update`` for an agent, whose normaliser learns from the data."""
    agent.normalizer.update(data["observation"], data["desired_goal"])
    if agent.hp.offline:
        rows = OfflineData(data, env, agent.goal_strategies, agent.gamma)
        return [[agent.extend(rows.sample(16), rows)] for _ in range(number)]
    num_demos = 4 if agent.hp.algo == "ddpg" else 0
    sizes = [16, num_demos] if num_demos else [16]
    return [[data[torch.randperm(200)[:size]] for size in sizes] for _ in range(number)]


@pytest.mark.parametrize(
    ("env_id", "preset", "algo"),
    [
        ("PandaFlip-v1", "recipe", "ddpg"),
        *(("PandaPush-v1", "recipe", algo) for algo in AGENTS),
        *(("PandaPush-v1", "offline", algo) for algo in OFFLINE_AGENTS),
    ],
)
def test_replayed_steps_equal_steps(env_id, preset, algo, monkeypatch):
    env, data = play(env_id)

    def train(*, records):
        monkeypatch.setattr(Agent, "records_steps", records)
        torch.manual_seed(0)
        agent = make_agent(env, default_args(preset, env_id, algo))
        number = agent.actor_interval * (WARM_UP + REPLAYS)
        batches, calls, losses = (
            make_batches(env, data, agent, number),
            [],
            agent.losses,
        )
        agent.losses = lambda b: calls.append(b) or losses(b)
        return agent, [agent.update(*batch) for batch in batches], len(calls)

    plain, expected, num_calls = train(records=False)
    assert num_calls == plain.updates == plain.actor_interval * (WARM_UP + REPLAYS)
    agent, curve, num_calls = train(records=True)
    assert num_calls == plain.actor_interval * (WARM_UP + 1)
    assert agent.updates == plain.updates
    torch.testing.assert_close(curve, expected, rtol=0, atol=0)
    weights = agent.state_dict(), plain.state_dict()
    torch.testing.assert_close(*weights, rtol=0, atol=0)


@pytest.mark.parametrize("algo", ["hiql", "qrl"])
def test_replayed_steps_of_stacked_agents_equal_steps(algo, monkeypatch):
    env, data = play("PandaPush-v1")

    def train(*, records):
        monkeypatch.setattr(Agent, "records_steps", records)
        torch.manual_seed(0)
        options = default_args("offline", "PandaPush-v1", algo)
        agents = [make_agent(env, options) for _ in range(2)]
        drawn = [make_batches(env, data, agent, WARM_UP + REPLAYS) for agent in agents]
        stacked = StackedAgents(agents)
        losses = [
            stacked.update([batch for (batch,) in batches])
            for batches in zip(*drawn, strict=True)
        ]
        stacked.write_back()
        return losses, [agent.state_dict() for agent in agents]

    expected = train(records=False)
    torch.testing.assert_close(train(records=True), expected, rtol=0, atol=0)
