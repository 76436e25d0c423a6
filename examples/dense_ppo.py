"""PPO with a dense reward on Reach: torchrl's own losses, without hindsight.

python examples/dense_ppo.py
"""

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage as Storage
from torchrl.data import SamplerWithoutReplacement as Sampler
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import CatTensors, Compose, ObservationNorm, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.modules.distributions import NormalParamExtractor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import torch_panda

NUM_ENVS = 16
TOTAL_STEPS = 24_000
STEPS_PER_BATCH = NUM_ENVS * 50  # one episode of each environment
EPOCHS = 10  # passes over each batch
MINIBATCH_SIZE = 200
LEARNING_RATE = 1e-3


def make_env(seed: int, num_envs: int) -> TransformedEnv:
    """Environments whose policy input is the observation and the goal, in decimetres.

    PPO never relabels goals, so the environment may concatenate them. Code that uses
    hindsight concatenates in the replay buffer instead, after `HindsightRelabel`.
    """
    env = torch_panda.make("PandaReachDense-v1", num_envs=num_envs, seed=seed)
    keys = ["observation", "desired_goal"]
    concatenate = CatTensors(keys, "policy_input", del_keys=False)
    scale = ObservationNorm(loc=0.0, scale=10.0, in_keys=["policy_input"])
    return TransformedEnv(env, Compose([concatenate, scale]))


def make_actor_critic(env: TransformedEnv) -> tuple[ProbabilisticActor, ValueOperator]:
    """A Gaussian policy squashed into the range of actions, and a value function."""
    sizes: dict = {"depth": 2, "num_cells": 64, "activation_class": nn.Tanh}
    net = MLP(out_features=2 * env.action_spec.shape[-1], **sizes)
    net.append(NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["policy_input"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(out_features=1, **sizes), in_keys=["policy_input"])
    TensorDictSequential([actor, critic])(env.reset())  # creates the lazy layers
    return actor, critic


def evaluate(actor: ProbabilisticActor, env: TransformedEnv) -> float:
    """Share of episodes that end in success when the policy acts without noise."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(50, actor)["next", "success"][:, -1].float().mean().item()


def main() -> float:
    """Train, and return the success of the trained policy."""
    torch.manual_seed(0)
    env = make_env(0, NUM_ENVS)
    actor, critic = make_actor_critic(env)
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LEARNING_RATE)
    buffer = TensorDictReplayBuffer(
        storage=Storage(STEPS_PER_BATCH), sampler=Sampler(), batch_size=MINIBATCH_SIZE
    )
    frames: dict = {"frames_per_batch": STEPS_PER_BATCH, "total_frames": TOTAL_STEPS}
    for iteration, data in enumerate(Collector(env, actor, **frames), start=1):
        with torch.no_grad():
            advantage(data)  # over the time of each environment, (16, 50)
        buffer.empty()
        buffer.extend(data.reshape(-1))
        for _ in range(EPOCHS):
            for batch in buffer:
                losses = loss(batch)
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        steps, reward = iteration * STEPS_PER_BATCH, data["next", "reward"].mean()
        success = data["next", "success"][:, -1].float().mean()
        print(f"{steps} steps: mean reward {reward:.3f}, success {success:.0%}")
    success = evaluate(actor, make_env(1, 50))
    print(f"without noise: success {success:.0%}")
    return success


if __name__ == "__main__":
    main()
