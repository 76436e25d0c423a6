"""DDPG with hindsight in plain torchrl: 100 % success at Reach after half a minute.

python examples/first_steps.py
"""

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, AdditiveGaussianModule, TanhModule
from torchrl.objectives import DDPGLoss, SoftUpdate

import torch_panda
from torch_panda.transforms import HindsightRelabel

torch.manual_seed(0)
env = torch_panda.make("PandaReach-v1", num_envs=8, seed=0)
test_env = torch_panda.make("PandaReach-v1", num_envs=50, seed=1)


class Net(MLP):
    """An MLP of observation, goal and action. Positions enter in decimetres."""

    def forward(self, *x: Tensor) -> Tensor:  # type: ignore[override]
        """(..., 6), (..., 3) and, for the critic, (..., 3) to (..., 3) or (..., 1)."""
        return super().forward(10 * x[0], 10 * x[1], *x[2:])  # type: ignore[arg-type]


inputs = ["observation", "desired_goal"]
net = Net(9, 3, depth=2, num_cells=256, activation_class=nn.ReLU)
policy = TensorDictModule(net, [*inputs], ["action"])
actor = TensorDictSequential([policy, TanhModule(in_keys=["action"])])
value = Net(12, 1, depth=2, num_cells=256, activation_class=nn.ReLU)
critic = TensorDictModule(value, [*inputs, "action"], ["state_action_value"])
noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.3, sigma_end=0.3)

loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=True)
loss.make_value_estimator(gamma=0.98)
target_update = SoftUpdate(loss, tau=0.05)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
# 80 % of the sampled rows get a goal that their episode reached later.
relabel = HindsightRelabel.from_env(env, her_ratio=0.8)
storage = LazyTensorStorage(100_000)
buffer = TensorDictReplayBuffer(storage=storage, transform=relabel, batch_size=256)
explore = TensorDictSequential([actor, noise])
frames: dict = {"frames_per_batch": 400, "total_frames": 2_400}
for data in Collector(env, explore, **frames, auto_register_policy_transforms=True):
    buffer.extend(data.reshape(-1))
    for _ in range(200):
        losses = loss(batch := buffer.sample())
        # Keeps actions small, because the tanh saturates at large ones.
        penalty = actor(batch.select(*inputs))["action"].square().mean()
        optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_value"] + penalty).backward()
        optimizer.step()
        target_update.step()
    with torch.no_grad():
        success = test_env.rollout(50, actor)["next", "success"][:, -1].float().mean()
    print(f"{len(buffer)} steps: success at the end of 50 episodes {success:.0%}")
