"""A policy that learns under randomised physics, by public names only."""

from contextlib import closing

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import DDPGLoss

import torch_panda
from torch_panda import Randomization
from torch_panda.noise import ActionDelay
from torch_panda.transforms import HindsightRelabel

# A policy in simulation may know the physics.
INPUTS = ["observation", "physics_parameters", "desired_goal"]


def make_mlp(size, out):
    """Of inputs that it concatenates; from -1 to 1."""
    return MLP(
        in_features=size,
        out_features=out,
        num_cells=[32],
        activation_class=nn.Tanh,
        activate_last_layer=out > 1,
    )


def test_ddpg_with_hindsight_learns_from_varied_physics():
    base = torch_panda.make(
        "PandaPush-v1",
        num_envs=4,
        seed=0,
        randomize=Randomization(
            object_mass=(0.5, 2.0), table_friction=(0.5, 1.5), observe=True
        ),
    )
    with closing(TransformedEnv(base, Compose(ActionDelay(1)))) as env:
        torch.manual_seed(0)
        size = 18 + 2 + 3
        policy = TensorDictModule(make_mlp(size, 3), INPUTS, ["action"])
        critic = ValueOperator(make_mlp(size + 3, 1), in_keys=[*INPUTS, "action"])
        loss = DDPGLoss(policy, critic)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(1_000),
            transform=HindsightRelabel.from_env(base),
            batch_size=64,
        )
        optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
        before = [weight.detach().clone() for weight in policy.parameters()]
        seen = []
        for data in Collector(env, policy, frames_per_batch=200, total_frames=400):
            seen.append(data["physics_parameters"][:, 0])
            buffer.extend(data.reshape(-1))
            for _ in range(5):
                losses = loss(buffer.sample())
                (losses["loss_actor"] + losses["loss_value"]).backward()
                optimiser.step()
                optimiser.zero_grad()
    drawn = torch.cat(seen)
    assert len(drawn.unique(dim=0)) == len(drawn) == 8  # two episodes of each
    after = list(policy.parameters())
    assert all((a != b).any() for a, b in zip(after, before, strict=True))
    assert all(weight.isfinite().all() for weight in after)
