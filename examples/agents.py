"""DDPG, TD3, SAC and TQC for goal-conditioned tasks, from torchrl's losses."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule as Mod
from tensordict.nn import TensorDictSequential as Seq
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    MLP,
    AdditiveGaussianModule,
    EGreedyModule,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
)
from torchrl.objectives import DDPGLoss, SACLoss, SoftUpdate, TD3Loss, TQCLoss
from torchrl.objectives.value import TD0Estimator

from geometry import read_geometry
from torch_panda import RobotTaskEnv

Algo = Literal["ddpg", "td3", "sac", "tqc"]

STATE_KEYS = ["observation", "desired_goal"]
STOCHASTIC = ("sac", "tqc")  # policies that draw their actions
CLIP_OBSERVATION = 200.0  # the panda-gym paper
CLIP_NORMALIZED = 5.0  # OpenAI Baselines' HER
POLICY_DELAY = 2  # TD3: critic updates per actor update (arXiv 1802.09477)
NUM_QUANTILES = 25  # TQC: per critic (arXiv 2005.04269)


@dataclass
class Hyperparameters:
    """Of the agents. The defaults are the panda-gym paper's (arXiv 2106.13687)."""

    algo: Algo = "ddpg"
    """algorithm"""
    double_q: bool = True
    """take the smaller of two Q networks' targets (TD3 and SAC) or the lower part of
    both (TQC); without it there is one Q network. DDPG has one in any case"""
    hidden_size: int = 256
    """units of each of the three layers of actor and critic"""
    learning_rate: float = 1e-3
    """of Adam, for actor and critic"""
    gamma: float | None = None
    """discount; None means 1 - 1 / steps of an episode, as OpenAI Baselines"""
    tau: float = 0.05
    """share of the new weights in the target networks (Polyak averaging 0.95)"""
    action_l2: float = 1.0
    """DDPG, TD3: weight of the mean squared action in the actor's loss"""
    random_eps: float = 0.3
    """DDPG, TD3: probability of a random action"""
    max_random_eps: float | None = None
    """DDPG, TD3: that probability in the last environment, the others being evenly
    spaced, so that some always explore; None means random_eps in all"""
    noise_eps: float = 0.2
    """DDPG, TD3: standard deviation of the Gaussian noise on actions"""
    policy_noise: float = 0.2
    """TD3: standard deviation of the noise on target actions, clipped at 0.5"""
    relative_inputs: bool = False
    """give the networks objects from the end-effector and goals from objects, too"""
    fine_inputs: float = 0.0
    """give them these differences once more, clipped at so much [m], if positive: they
    resolve millimetres where hand and object are close"""
    goal_height: float | None = None
    """show the networks all goals at this height [m]. Slide draws goals 1.5 cm above
    where its puck can be, by which they would be told from hindsight goals"""
    mirror: bool = False
    """mirror half of each batch in the plane in which robot and table are symmetric"""
    shift: float = 0.0
    """move the scene in half of each batch by up to so much in x and y [m]"""
    bc_weight: float = 20.0
    """DDPG, TD3: weight, in the actor's loss, of the squared difference to the actions
    of demonstrations (arXiv 1709.10089)"""
    q_filter: bool = True
    """imitate only demonstrations whose action the critic prefers to the policy's"""
    alpha: float = 0.2
    """SAC, TQC: entropy coefficient, or its first value"""
    learn_alpha: bool = False
    """SAC, TQC: tune the entropy coefficient towards an entropy of -action size"""
    drop_quantiles: int = 2
    """TQC: quantiles per critic that the target leaves out, the highest ones"""


class Normalizer(nn.Module):
    """Running standardisation of what the networks see, as in OpenAI Baselines.

    Args:
        env: the environment.
        hp: what the networks see.
    """

    count: Tensor
    total: Tensor
    total_squared: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, env: RobotTaskEnv, hp: Hyperparameters) -> None:
        super().__init__()
        self.hyperparameters = hp
        self.geometry = geometry = read_geometry(env)
        self.heights = [start + 2 for start in geometry.goal_positions]
        size = sum(env.observation_spec[key].shape[-1] for key in STATE_KEYS)
        if hp.relative_inputs:
            size += len(geometry.later) * (2 if hp.fine_inputs else 1)
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("total", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("total_squared", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    def update(self, observation: Tensor, goal: Tensor) -> None:
        """Take more rows, (..., size of each), into the statistics."""
        rows = self._inputs(observation, goal).flatten(0, -2).double()
        self.count += len(rows)
        self.total += rows.sum(0)
        self.total_squared += rows.square().sum(0)
        mean = self.total / self.count
        variance = (self.total_squared / self.count - mean.square()).clamp(min=1e-4)
        self.mean.copy_(mean)
        self.std.copy_(variance.sqrt())

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Standardise (..., size of each) to (..., size)."""
        normalized = (self._inputs(observation, goal) - self.mean) / self.std
        return normalized.clamp(-CLIP_NORMALIZED, CLIP_NORMALIZED)

    def _inputs(self, observation: Tensor, goal: Tensor) -> Tensor:
        hp = self.hyperparameters
        if hp.goal_height is not None:
            goal = goal.clone()
            goal[..., self.heights] = hp.goal_height
        inputs = [observation, goal]
        if hp.relative_inputs:
            differences = self.geometry.differences(observation, goal)
            inputs.append(differences)
            if hp.fine_inputs:
                inputs.append(differences.clamp(-hp.fine_inputs, hp.fine_inputs))
        return torch.cat(inputs, -1).clamp(-CLIP_OBSERVATION, CLIP_OBSERVATION)


class ClippedTD0(TD0Estimator):
    """TD(0) targets within what a return of rewards in [-1, 0] can be (Baselines)."""

    def value_estimate(self, *args: object, **kwargs: object) -> Tensor:
        """The target, clipped to [-1 / (1 - gamma), 0]."""
        target = super().value_estimate(*args, **kwargs)
        return target.clamp(float(-1 / (1 - self.gamma)), 0.0)


class Agent(nn.Module):
    """A policy, how it explores, and how it learns.

    Args:
        env: the environment, for the sizes of its spaces.
        hyperparameters: what to build.
        max_episode_steps: for the discount where ``gamma`` is None.
        sparse: whether rewards are -1 and 0, so that DDPG's and TD3's targets can be
            clipped.

    Attributes:
        normalizer: standardises observation and goal.
        policy: TensorDictModule from ``observation`` and ``desired_goal`` to
            ``action``; deterministic under ``ExplorationType.DETERMINISTIC``.
        explore: the policy with the algorithm's exploration noise.
        loss: torchrl's loss module; its state holds all the weights.
    """

    def __init__(
        self,
        env: RobotTaskEnv,
        hyperparameters: Hyperparameters,
        *,
        max_episode_steps: int,
        sparse: bool,
    ) -> None:
        super().__init__()
        hp = self.hyperparameters = hyperparameters
        num_q = 2 if hp.double_q and hp.algo != "ddpg" else 1

        self.normalizer, actor, normalize = _make_policy(env, hp)
        self.geometry = self.normalizer.geometry
        if hp.fine_inputs and not hp.relative_inputs:
            raise ValueError("fine_inputs needs relative_inputs")
        if hp.goal_height is not None and not self.geometry.goal_positions:
            raise ValueError("goal_height is for goals that are positions")
        if (hp.mirror or hp.shift) and self.geometry.action is None:
            raise ValueError(
                "mirror and shift are for end-effector control: with joint control "
                "pass --no-mirror --shift 0"
            )
        critic = Mod(
            MLP(
                in_features=len(self.normalizer.mean) + env.action_spec.shape[-1],
                out_features=NUM_QUANTILES if hp.algo == "tqc" else 1,
                num_cells=[hp.hidden_size] * 3,
                activation_class=nn.ReLU,
            ),
            ["normalized", "action"],
            ["state_action_value"],
        )
        self.policy = self.explore = Seq(normalize, actor)
        action_spec = env.action_spec_unbatched
        if hp.algo in STOCHASTIC:
            loss_class = SACLoss if hp.algo == "sac" else TQCLoss
            options: dict[str, object] = {
                "num_qvalue_nets": num_q,
                "deactivate_vmap": True,  # faster on CPU
                "alpha_init": hp.alpha,
                "fixed_alpha": not hp.learn_alpha,
                "action_spec": action_spec,
            }
            if hp.algo == "sac":
                options["loss_function"] = "l2"
            else:
                options["top_quantiles_to_drop_per_net"] = (
                    hp.drop_quantiles if hp.double_q else 0
                )
            self.loss = loss_class(actor, critic, **options)
            # A buffer, but only once it was asked for: in the states that runs save.
            _ = self.loss.target_entropy
        else:
            sigma = {"sigma_init": hp.noise_eps, "sigma_end": hp.noise_eps}
            eps = {"eps_init": hp.random_eps, "eps_end": hp.random_eps}
            random_action = EGreedyModule(env.action_spec, **eps)
            if hp.max_random_eps is not None:
                # (num_envs,): compared with one random number per environment.
                random_action.eps = torch.linspace(
                    hp.random_eps, hp.max_random_eps, env.batch_size[0]
                )
            self.explore = Seq(
                normalize,
                actor,
                AdditiveGaussianModule(env.action_spec, **sigma),
                random_action,
            )
            if hp.algo == "ddpg":
                self.loss = DDPGLoss(
                    actor,
                    critic,
                    loss_function="l2",
                    delay_actor=True,
                    delay_value=True,
                )
            else:
                self.loss = TD3Loss(
                    actor,
                    critic,
                    num_qvalue_nets=num_q,
                    deactivate_vmap=True,  # faster on CPU
                    loss_function="l2",
                    policy_noise=hp.policy_noise,
                    noise_clip=0.5,
                    action_spec=action_spec,
                )
            actor.module.register_forward_hook(self._remember_action)
            critic.module.register_forward_hook(self._remember_value)
        self._set_discount(hp.gamma or 1 - 1 / max_episode_steps, sparse)
        self.soft_update = SoftUpdate(self.loss, tau=hp.tau)
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=hp.learning_rate, fused=True
        )
        self.updates = 0

    def update(
        self, batch: TensorDictBase, demos: TensorDictBase | None = None
    ) -> dict[str, Tensor]:
        """One gradient step on a batch of transitions, and one of demonstrations.

        Returns:
            the losses, scalars.
        """
        for part in (batch,) if demos is None else (batch, demos):
            self._transform(part)
        num_demos = 0 if demos is None else len(demos)
        if demos is not None:
            batch = torch.cat((batch, demos))
        batch = batch.set("normalized", self._normalize(batch))
        batch.set(("next", "normalized"), self._normalize(batch["next"]))
        losses = self._losses(batch, num_demos)
        self._descend(torch.stack(tuple(losses.values())).sum())
        self.updates += 1
        return {key: value.detach() for key, value in losses.items()}

    def imitate(self, demos: TensorDictBase) -> Tensor:
        """One gradient step of the policy alone, towards actions of demonstrations.

        Returns:
            the mean squared difference, a scalar.
        """
        self._transform(demos)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = self.policy(demos.select(*STATE_KEYS))["action"]
        loss = nn.functional.mse_loss(action, demos["action"])
        self._descend(loss)
        return loss.detach()

    def _losses(self, batch: TensorDictBase, num_demos: int) -> dict[str, Tensor]:
        """Losses whose gradients touch only the network that each one trains.

        The last rows of the batch are demonstrations.
        """
        algo, loss = self.hyperparameters.algo, self.loss
        if algo in STOCHASTIC:
            every = loss(batch)
            return {key: every[key] for key in loss.out_keys if key.startswith("loss_")}
        if algo == "ddpg":
            value_loss, actor_loss = loss.loss_value, loss.loss_actor
            delay = 1
        else:
            value_loss, actor_loss = loss.value_loss, loss.actor_loss
            delay = POLICY_DELAY
        losses = {"loss_value": value_loss(batch)[0]}
        stored_value = self._value
        if self.updates % delay == 0:
            losses["loss_actor"] = actor_loss(batch)[0]
            # The actor's loss has just computed its actions and their values.
            penalty = self.hyperparameters.action_l2 * self._action.square().mean()
            losses["loss_actor"] = losses["loss_actor"] + penalty
            if num_demos:
                demos = slice(-num_demos, None)
                error = (self._action - batch["action"])[demos].square()
                if self.hyperparameters.q_filter:
                    error = error * (stored_value[demos] > self._value[demos])
                losses["loss_bc"] = self.hyperparameters.bc_weight * error.mean()
        return losses

    def _descend(self, loss: Tensor) -> None:
        """Take a gradient step, and let the target networks follow."""
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.soft_update.step()

    def _transform(self, batch: TensorDictBase) -> None:
        """Mirror some of a batch's rows and move some over the table, if asked to."""
        if self.hyperparameters.mirror:
            self.geometry.mirror(batch)
        if self.hyperparameters.shift:
            self.geometry.shift(batch, self.hyperparameters.shift)

    def _remember_action(self, module: nn.Module, inputs: object, out: Tensor) -> None:
        """Keep the actions that gradients flow through: torchrl's losses do not."""
        if out.requires_grad:
            self._action = out

    def _remember_value(self, module: nn.Module, inputs: object, out: Tensor) -> None:
        """Keep the values of the batch: targets are computed without gradients."""
        if out.requires_grad:
            self._value = out.detach()

    def _normalize(self, tensordict: TensorDictBase) -> Tensor:
        return self.normalizer(*(tensordict[key] for key in STATE_KEYS))

    def _set_discount(self, gamma: float, sparse: bool) -> None:
        if self.hyperparameters.algo == "ddpg":
            self.loss.make_value_estimator(
                ClippedTD0 if sparse else TD0Estimator,
                gamma=gamma,
                value_network=self.loss.actor_critic,
            )
            self.loss.set_keys(state_action_value="state_action_value")
        elif self.hyperparameters.algo == "td3" and sparse:
            self.loss.make_value_estimator(ClippedTD0, gamma=gamma, value_network=None)
            self.loss.set_keys(state_action_value="state_action_value")
        else:
            self.loss.make_value_estimator(gamma=gamma)


def _make_policy(env: RobotTaskEnv, hp: Hyperparameters) -> tuple[Normalizer, Mod, Mod]:
    """The normaliser, the actor from ``normalized``, and the module between them."""
    normalizer = Normalizer(env, hp)
    normalize = Mod(normalizer, STATE_KEYS, ["normalized"])
    stochastic = hp.algo in STOCHASTIC
    net = MLP(
        in_features=len(normalizer.mean),
        out_features=env.action_spec.shape[-1] * (2 if stochastic else 1),
        num_cells=[hp.hidden_size] * 3,
        activation_class=nn.ReLU,
    )
    if not stochastic:
        actor = Mod(nn.Sequential(net, nn.Tanh()), ["normalized"], ["action"])
        return normalizer, actor, normalize
    parameters = Mod(
        nn.Sequential(net, NormalParamExtractor()), ["normalized"], ["loc", "scale"]
    )
    actor = ProbabilisticActor(
        parameters, in_keys=["loc", "scale"], distribution_class=TanhNormal
    )
    return normalizer, actor, normalize


def save_policy(path: Path, agent: Agent, env_id: str) -> None:
    """Write what `load_policy` needs: weights, normaliser and how to build them."""
    state = {
        "env_id": env_id,
        "hyperparameters": {
            field.name: getattr(agent.hyperparameters, field.name)
            for field in fields(Hyperparameters)
        },
        "policy": agent.policy.state_dict(),
    }
    replace(path, lambda temporary: torch.save(state, temporary))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What `save_policy` wrote, on the CPU.

    Raises:
        ValueError: the file holds no policy.
    """
    keys = ("env_id", "hyperparameters", "policy")
    return read(path, "a policy", keys, map_location="cpu")


def load_policy(checkpoint: dict[str, Any], env: RobotTaskEnv) -> Seq:
    """The policy of a checkpoint that `save_policy` wrote.

    Raises:
        ValueError: the environment's spaces are not those it was trained on, or
            another version wrote the checkpoint.
    """
    options = checkpoint["hyperparameters"]
    if unknown := options.keys() - {field.name for field in fields(Hyperparameters)}:
        raise ValueError(
            f"the policy was saved by another version, with options that this one does "
            f"not have: {', '.join(sorted(unknown))}"
        )
    hp = Hyperparameters(**options)
    _, actor, normalize = _make_policy(env, hp)
    policy = Seq(normalize, actor)
    try:
        policy.load_state_dict(checkpoint["policy"])
    except RuntimeError:
        raise ValueError(
            f"the policy was trained on {checkpoint['env_id']}, whose spaces are not "
            "those of this environment"
        ) from None
    return policy


def replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file whole or not at all: a kill never leaves half of it."""
    temporary = path.with_name(path.name + ".new")
    write(temporary)
    os.replace(temporary, path)


def read(
    path: Path,
    what: str,
    keys: Iterable[NestedKey],
    **options: Any,  # noqa: ANN401 (those of torch.load)
) -> Any:  # noqa: ANN401 (what was saved)
    """Read a file of tensors, numbers and dicts that torch.save wrote.

    Nothing in it is run, so it may come from a stranger.

    Args:
        path: of the file.
        what: it should hold, for the error.
        keys: that this has.
        options: of torch.load.

    Raises:
        ValueError: it is missing, empty or damaged, or holds something else.
    """
    if not path.exists():
        raise ValueError(f"there is no file {path}")
    try:
        content = torch.load(path, weights_only=True, **options)
        for key in keys:
            reduce(getitem, key if isinstance(key, tuple) else (key,), content)
    except Exception as error:  # of almost any kind: it depends on the bytes
        raise ValueError(
            f"{path} does not hold {what}, or is damaged ({type(error).__name__})"
        ) from None
    return content
