"""A policy that sees pixels: Reach from a camera, with a convolutional encoder.

    python examples/pixels.py

The actor sees a picture of the arm and the goal's position. Only training needs the
critic, so the critic sees the state (asymmetric actor-critic, arXiv 1710.06542). The
reward is dense: after relabelling, a picture would still show the old goal's marker.
"""

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, AdditiveGaussianModule, ConvNet, TanhModule
from torchrl.objectives import DDPGLoss, SoftUpdate

import torch_panda

ENV_ID = "PandaReachDense-v1"
NUM_ENVS = 8
STEPS: dict = {"frames_per_batch": 400, "total_frames": 4_000}
UPDATES_PER_BATCH = 150
SIZE = 48  # of the pictures [pixels]
CAMERA = torch_panda.Camera((0.0, 0.0, 0.15), distance=0.8, yaw=60, shadows=False)


def make_env(seed: int, num_envs: int) -> torch_panda.RobotTaskEnv:
    """Environments that also observe ``pixels``, (num_envs, 48, 48, 3) uint8."""
    pixels: dict = {"from_pixels": True, "camera": CAMERA, "render_size": SIZE}
    return torch_panda.make(ENV_ID, num_envs=num_envs, seed=seed, **pixels)


class PixelActor(nn.Module):
    """From a picture and a goal to an action before the tanh."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = ConvNet(3, num_cells=[16, 32, 32], strides=2)
        self.features = nn.Sequential(nn.LazyLinear(64), nn.LayerNorm(64), nn.Tanh())
        self.head = MLP(in_features=67, out_features=3, depth=2, num_cells=128)

    def forward(self, pixels: Tensor, goal: Tensor) -> Tensor:
        """(..., height, width, 3) uint8 and (..., 3) [m] to (..., 3)."""
        features = self.features(self.encoder(pixels.movedim(-1, -3) / 255 - 0.5))
        return self.head(torch.cat((features, 10 * goal), dim=-1))


class StateCritic(MLP):
    """From state, goal and action to a value. Positions enter in decimetres."""

    def forward(self, *inputs: Tensor) -> Tensor:  # type: ignore[override]
        """(..., 6), (..., 3) and (..., 3) to (..., 1)."""
        observation, goal, action = inputs  # torchrl types them as tuples
        return super().forward(10 * observation, 10 * goal, action)  # type: ignore


@torch.no_grad()
def evaluate(actor: TensorDictSequential, env: torch_panda.RobotTaskEnv) -> Tensor:
    """Mean distance from the goal at the end of the same episodes in each call [m]."""
    env.set_seed(1)
    rollout = env.rollout(50, actor)
    error = rollout["next", "achieved_goal"] - rollout["next", "desired_goal"]
    return error[:, -1].norm(dim=-1).mean()


def main() -> tuple[float, float]:
    """Train, and return the mean final distance before and after [m]."""
    torch.manual_seed(0)
    env, test_env = make_env(0, NUM_ENVS), make_env(1, 8)
    net = TensorDictModule(PixelActor(), ["pixels", "desired_goal"], ["action"])
    actor = TensorDictSequential([net, TanhModule(in_keys=["action"])])
    before = evaluate(actor, test_env).item()  # also creates the lazy layers
    value = StateCritic(12, 1, depth=2, num_cells=256, activation_class=nn.ReLU)
    keys = ["observation", "desired_goal", "action"]
    critic = TensorDictModule(value, [*keys], ["state_action_value"])
    loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=True)
    loss.make_value_estimator(gamma=0.8)
    target_update = SoftUpdate(loss, tau=0.02)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=64)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.5, sigma_end=0.5)
    explore = TensorDictSequential([actor, noise])
    for data in Collector(env, explore, **STEPS, auto_register_policy_transforms=True):
        buffer.extend(data.reshape(-1))
        for _ in range(UPDATES_PER_BATCH):
            losses = loss(batch := buffer.sample())
            penalty = 0.02 * actor(batch.clone())["action"].square().mean()
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_value"] + penalty).backward()
            optimizer.step()
            target_update.step()
        distance = evaluate(actor, test_env).item()
        print(f"{len(buffer)} steps: {100 * distance:.1f} cm from the goal at the end")
    return before, distance


if __name__ == "__main__":
    main()
