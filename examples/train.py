"""Train DDPG with hindsight experience replay on any task, Reach unless told otherwise.

    python examples/train.py --env-id PandaPush-v1 --total-steps 300000

Hyperparameters are those of the panda-gym paper (arXiv 2106.13687); where its table is
silent they follow the HER of OpenAI Baselines, and the comment says so.
"""

import csv
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, AdditiveGaussianModule, EGreedyModule
from torchrl.objectives import DDPGLoss, SoftUpdate
from torchrl.objectives.value import TD0Estimator
from tqdm import tqdm

import torch_panda
from torch_panda.transforms import HindsightRelabel


@dataclass
class Args:
    """What to train, how long, and where to write."""

    env_id: str = "PandaReach-v1"
    """one of torch_panda.ENV_IDS"""
    seed: int = 0
    """of the environments, the networks and the sampling"""
    num_envs: int = 8
    """environments that are stepped in parallel"""
    num_threads: int | None = None
    """threads that step them; None means one per core"""
    total_steps: int = 10_000
    """environment steps, over all environments"""
    updates_per_step: float = 0.5
    """gradient steps per environment step"""
    eval_interval: int = 1_000
    """environment steps between evaluations"""
    eval_episodes: int = 80
    """fresh episodes per evaluation"""
    out: Path | None = None
    """folder of the results; None means runs/<env-id>-<seed>"""

    learning_rate: float = 1e-3
    """of Adam, for actor and critic"""
    batch_size: int = 256
    """transitions per gradient step"""
    tau: float = 0.05
    """share of the new weights in the target networks (Polyak averaging 0.95)"""
    her_ratio: float = 0.8
    """share of relabelled transitions: k = 4 goals per transition"""
    action_l2: float = 1.0
    """weight of the mean squared action in the actor's loss"""
    random_eps: float = 0.3
    """probability of a random action"""
    noise_eps: float = 0.2
    """standard deviation of the Gaussian noise on actions"""
    buffer_size: int = 1_000_000
    """transitions in the replay buffer"""


STATE_KEYS = ["observation", "desired_goal"]
CLIP_OBSERVATION = 200.0  # the paper
CLIP_NORMALIZED = 5.0  # OpenAI Baselines


class Normalizer(nn.Module):
    """Running standardisation of what the networks see, as in OpenAI Baselines."""

    count: Tensor
    total: Tensor
    total_squared: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("total", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("total_squared", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def update(self, observation: Tensor, goal: Tensor) -> None:
        """Take more rows, (..., size of each), into the statistics."""
        rows = torch.cat((observation, goal), -1).flatten(0, -2).double()
        rows = rows.clamp(-CLIP_OBSERVATION, CLIP_OBSERVATION)
        self.count += len(rows)
        self.total += rows.sum(0)
        self.total_squared += rows.square().sum(0)
        mean = self.total / self.count
        variance = (self.total_squared / self.count - mean.square()).clamp(min=1e-4)
        self.mean.copy_(mean)
        self.std.copy_(variance.sqrt())

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Standardise (..., size of each) to (..., size)."""
        inputs = torch.cat((observation, goal), -1)
        inputs = inputs.clamp(-CLIP_OBSERVATION, CLIP_OBSERVATION)
        normalized = (inputs - self.mean) / self.std
        return normalized.clamp(-CLIP_NORMALIZED, CLIP_NORMALIZED)


class ClippedTD0(TD0Estimator):
    """TD(0) targets within what a return of rewards in [-1, 0] can be (Baselines)."""

    def value_estimate(self, *args: object, **kwargs: object) -> Tensor:
        """The target, clipped to [-1 / (1 - gamma), 0]."""
        target = super().value_estimate(*args, **kwargs)
        return target.clamp(float(-1 / (1 - self.gamma)), 0.0)


def make_networks(env: torch_panda.RobotTaskEnv) -> tuple[Normalizer, Seq, Seq]:
    """The normaliser, the actor and the critic: three layers of 256 units each."""
    size = sum(env.observation_spec[key].shape[-1] for key in STATE_KEYS)
    action_size = env.action_spec.shape[-1]
    normalizer = Normalizer(size)
    hidden = {"num_cells": [256, 256, 256], "activation_class": nn.ReLU}
    policy = nn.Sequential(
        MLP(in_features=size, out_features=action_size, **hidden), nn.Tanh()
    )
    value = MLP(in_features=size + action_size, out_features=1, **hidden)
    normalize = Mod(normalizer, STATE_KEYS, ["normalized"])
    actor = Seq(normalize, Mod(policy, ["normalized"], ["action"]))
    critic = Seq(
        normalize, Mod(value, ["normalized", "action"], ["state_action_value"])
    )
    return normalizer, actor, critic


def evaluate(env: torch_panda.RobotTaskEnv, actor: Seq, episodes: int) -> float:
    """Share of fresh episodes that end in success."""
    successes: list[bool] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        while len(successes) < episodes:
            rollout = env.rollout(
                env.max_episode_steps, actor, break_when_any_done=False
            )
            # A -v3 episode ends at its first success, which `any` finds.
            last = rollout["next", "success"]
            done = last.any(1) if env.terminate_on_success else last[:, -1]
            successes += done.flatten().tolist()
    return sum(successes[:episodes]) / episodes


def plot(curve: list[dict[str, float]], env_id: str, path: Path) -> None:
    """Draw the learning curve."""
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    axes.plot([row["step"] for row in curve], [row["success"] for row in curve], "o-")
    axes.set(xlabel="environment steps", ylabel="success rate", ylim=(-0.05, 1.05))
    axes.set_title(env_id)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def write_results(
    out: Path, curve: list[dict[str, float]], args: Args, networks: nn.ModuleDict
) -> None:
    """Write the curve as CSV and PNG, and the checkpoint."""
    if curve:
        with (out / "curve.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(curve[0]))
            writer.writeheader()
            writer.writerows(curve)
        plot(curve, args.env_id, out / "curve.png")
    checkpoint = {"env_id": args.env_id, "networks": networks.state_dict()}
    torch.save(checkpoint, out / "checkpoint.pt")


def main(args: Args) -> None:
    """Collect, learn, evaluate, and write what came out."""
    if args.total_steps < 1 or args.updates_per_step < 0:
        raise SystemExit("total_steps must be positive, updates_per_step not negative")
    out = args.out or Path("runs") / f"{args.env_id}-{args.seed}"
    torch.manual_seed(args.seed)
    try:
        env = torch_panda.make(
            args.env_id, num_envs=args.num_envs, num_threads=args.num_threads
        )
    except ValueError as error:
        raise SystemExit(str(error)) from None
    out.mkdir(parents=True, exist_ok=True)
    (out / "args.json").write_text(json.dumps(asdict(args), default=str, indent=2))
    eval_env = torch_panda.make(
        args.env_id,
        num_envs=min(16, args.eval_episodes),
        num_threads=args.num_threads,
        seed=args.seed + 1_000_000,
    )

    normalizer, actor, critic = make_networks(env)
    networks = nn.ModuleDict({"actor": actor, "critic": critic})
    loss_module = DDPGLoss(actor, critic, loss_function="l2", delay_value=True)
    gamma = 1 - 1 / env.max_episode_steps  # OpenAI Baselines
    # The bounds that targets are clipped to hold for rewards of -1 and 0.
    estimator = TD0Estimator if "Dense" in args.env_id else ClippedTD0
    loss_module.make_value_estimator(
        estimator, gamma=gamma, value_network=loss_module.actor_critic
    )
    loss_module.set_keys(state_action_value="state_action_value")
    soft_update = SoftUpdate(loss_module, tau=args.tau)
    actor_optimizer = torch.optim.Adam(
        loss_module.actor_network_params.values(True, True), lr=args.learning_rate
    )
    critic_optimizer = torch.optim.Adam(
        loss_module.value_network_params.values(True, True), lr=args.learning_rate
    )

    explore = Seq(
        actor,
        AdditiveGaussianModule(
            env.action_spec, sigma_init=args.noise_eps, sigma_end=args.noise_eps
        ),
        EGreedyModule(
            env.action_spec, eps_init=args.random_eps, eps_end=args.random_eps
        ),
    )
    collector = Collector(
        env,
        explore,
        frames_per_batch=args.num_envs * 5,
        total_frames=args.total_steps,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=True,
    )
    collector.set_seed(args.seed)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(min(args.buffer_size, args.total_steps + 1000)),
        transform=HindsightRelabel(
            env.compute_reward, her_ratio=args.her_ratio, seed=args.seed
        ),
        batch_size=args.batch_size,
    )

    def learn(batch: TensorDictBase) -> None:
        """One gradient step of both networks."""
        losses = loss_module(batch)
        action = actor(batch.select(*STATE_KEYS))["action"]
        actor_loss = losses["loss_actor"] + args.action_l2 * action.square().mean()
        actor_optimizer.zero_grad()
        critic_optimizer.zero_grad()
        (actor_loss + losses["loss_value"]).backward()
        actor_optimizer.step()
        critic_optimizer.step()
        soft_update.step()

    curve: list[dict[str, float]] = []
    steps, updates, next_evaluation = 0, 0, args.eval_interval
    start = time.perf_counter()
    progress = tqdm(total=args.total_steps, unit="step", desc=args.env_id)
    try:
        for data in collector:
            data = data.exclude("normalized", ("next", "normalized"))
            normalizer.update(data["observation"], data["desired_goal"])
            buffer.extend(data.reshape(-1))
            steps += data.numel()
            while updates < steps * args.updates_per_step:
                learn(buffer.sample())
                updates += 1
            progress.update(data.numel())
            if steps >= next_evaluation or steps >= args.total_steps:
                next_evaluation += args.eval_interval
                success = evaluate(eval_env, actor, args.eval_episodes)
                seconds = round(time.perf_counter() - start, 2)
                curve.append(
                    {
                        "step": steps,
                        "success": success,
                        "updates": updates,
                        "seconds": seconds,
                    }
                )
                progress.set_postfix(success=f"{success:.0%}")
                write_results(out, curve, args, networks)
    except KeyboardInterrupt:
        progress.write(f"interrupted after {steps} steps")
    finally:
        progress.close()
        write_results(out, curve, args, networks)
        collector.shutdown()
        eval_env.close()
    if curve:
        print(f"success {curve[-1]['success']:.0%} after {steps} steps; see {out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
