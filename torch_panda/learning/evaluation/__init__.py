"""Evaluation of a policy over many episodes, which run in parallel."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import sqrt
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_panda.checks import check_positive
from torch_panda.envs import RobotTaskEnv
from torch_panda.learning.environments import GoalEnv, make_env, refusal
from torch_panda.learning.evaluation.fixed_tasks import evaluation_tasks
from torch_panda.learning.evaluation.rollouts import Policy, play_episodes

Tasks = Literal["random", "fixed"]

# Number of random actions at the beginning of each episode from a fixed start. Without
# them all episodes from one start would be the same.
RANDOM_ACTIONS = 3


@dataclass(frozen=True)
class Evaluation:
    """Results of n episodes.

    Attributes:
        success: Whether each episode ends with its goal reached, (n,) bool.
        ever: Whether the goal was reached after any step of each episode, (n,) bool.
        at_start: Whether each episode starts with its goal reached, (n,) bool.
        returns: Sum of the rewards of each episode, (n,).
        lengths: Number of steps of each episode, (n,).
        tasks: Results from each of the five `evaluation_tasks`, by name. Empty for
            random starts.
    """

    success: Tensor
    ever: Tensor
    at_start: Tensor
    returns: Tensor
    lengths: Tensor
    tasks: Mapping[str, "Evaluation"] = field(default_factory=dict)

    @property
    def success_rate(self) -> float:
        """Share of the episodes that end with success."""
        return float(self.success.double().mean())

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % confidence interval of the success rate."""
        return wilson_interval(int(self.success.sum()), len(self.success))

    @property
    def mean_return(self) -> float:
        """Mean return of the episodes."""
        return float(self.returns.double().mean())

    @property
    def mean_length(self) -> float:
        """Mean number of steps of an episode.

        Episodes of ids with ``-v3`` end with the first success.
        """
        return float(self.lengths.double().mean())

    def __repr__(self) -> str:
        low, high = self.interval
        tasks = "".join(
            f", {name}={result.success_rate:.3f}" for name, result in self.tasks.items()
        )
        return (
            f"Evaluation({len(self.success)} episodes, success_rate="
            f"{self.success_rate:.3f} [{low:.3f}, {high:.3f}]{tasks}, mean_return="
            f"{self.mean_return:.2f}, mean_length={self.mean_length:.1f})"
        )


def evaluate(
    policy: Policy,
    env_id: str,
    *,
    episodes: int = 200,
    seed: int | None = 1_000,
    num_envs: int = 32,
    tasks: Tasks = "random",
    **options: Any,  # noqa: ANN401 (options of `make`)
) -> Evaluation:
    """Evaluate a policy on an environment, without exploration noise.

    Args:
        policy: Trained policy, scripted expert, or any module or function that writes
            ``action`` into a TensorDict with the observations. A module acts in
            evaluation mode (`torch.nn.Module.eval`).
        env_id: Id of the environment.
        episodes: Number of episodes.
        seed: Seed of the episodes; None draws a random seed.
        num_envs: Number of environments stepped in parallel, at most one for each
            episode. Random starts depend on this number, fixed starts do not.
        tasks: "random" draws the start and the goal of each episode. "fixed" takes them
            from the five `torch_panda.evaluation_tasks`, and also reports the success
            from each of these starts. ``episodes`` is then rounded up to a multiple of
            five, so that each start gets the same number of episodes. Each episode
            begins with `RANDOM_ACTIONS` random actions, drawn from ``seed``, so that
            the episodes from one start differ.
        **options: Other arguments of `make`, such as ``task_options`` and ``device``,
            or ``workers`` for an id of Gymnasium.

    Raises:
        ValueError: The id is unknown, or an argument is out of range.
        TypeError: The policy cannot be called or returns no TensorDict, or an argument
            is unknown.
    """
    check_positive(episodes=episodes, num_envs=num_envs)
    if not callable(policy) or isinstance(policy, type):
        raise TypeError(
            f"policy must be a module or a function, got {policy!r}: load_policy reads "
            "one from a file"
        )
    if tasks not in get_args(Tasks):
        raise ValueError(f'tasks must be "random" or "fixed", got {tasks!r}')
    acting = policy
    if not isinstance(policy, TensorDictModuleBase):
        acting = _check_results(policy)
    num_envs = min(num_envs, episodes)
    with (
        _evaluation_mode(policy),
        make_env(env_id, num_envs=num_envs, seed=seed, **options) as env,
    ):
        if tasks == "fixed":
            if not isinstance(env, RobotTaskEnv):
                raise refusal(env_id, "fixed tasks")
            states = evaluation_tasks(env_id)
            return evaluate_fixed_starts(env, acting, episodes, states, seed=seed)
        return evaluate_episodes(env, acting, episodes)


@contextmanager
def _evaluation_mode(policy: Policy) -> Iterator[None]:
    """Put a module into evaluation mode, and then all its parts back as they were.

    In training mode, dropout is random, and batch normalisation changes the policy.
    """
    if not isinstance(policy, torch.nn.Module):
        yield
        return
    training = [module for module in policy.modules() if module.training]
    policy.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


def _check_results(policy: Policy) -> Policy:
    """Return a function that refuses other results of a policy than a TensorDict."""
    keys = "in_keys=[...], out_keys=['action']"
    hint = f"wrap a network as TensorDictModule(network, {keys})"

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        try:
            result = policy(tensordict)
        except TypeError as error:
            raise TypeError(f"policy failed with a TensorDict: {hint}") from error
        if result is None:  # the policy has changed the TensorDict in place
            return tensordict
        if not isinstance(result, TensorDictBase):
            raise TypeError(
                f"policy must write 'action' into the TensorDict and return it, got "
                f"{type(result).__name__}: {hint}"
            )
        return result

    return act


def evaluate_episodes(env: GoalEnv, policy: Policy, episodes: int) -> Evaluation:
    """Evaluate a policy over the next episodes of a batch of environments."""
    parts: list[Evaluation] = []
    while sum(len(part.success) for part in parts) < episodes:
        parts.append(_summarize(*play_episodes(env, policy)))
    return _join(parts, range(episodes))


def evaluate_fixed_starts(
    env: RobotTaskEnv,
    policy: Policy,
    episodes: int,
    states: Mapping[str, TensorDict],
    *,
    seed: int | None,
) -> Evaluation:
    """Evaluate a policy from fixed starts, in a batch of environments.

    The episodes do not depend on the number of environments.

    Args:
        env: Batched environment.
        policy: Policy that writes ``action``.
        episodes: Number of episodes, rounded up to the same number for each start.
        states: Start states by name, as `evaluation_tasks` returns them.
        seed: Seed of the first `RANDOM_ACTIONS` actions; None draws a random seed.
    """
    episodes += -episodes % len(states)  # round up
    num_envs = env.batch_size[0]
    generator = torch.Generator()
    if seed is None:
        generator.seed()
    else:
        generator.manual_seed(seed)
    shape = (episodes, RANDOM_ACTIONS, env.action_spec.shape[-1])
    actions = (2 * torch.rand(shape, generator=generator) - 1).to(env.device)
    starts = TensorDict.stack(list(states.values())).to(env.device)
    parts: list[Evaluation] = []
    for first in range(0, episodes, num_envs):
        # If fewer episodes than environments are left for the last batch, the first
        # episodes fill it up. `_join` drops these repeats.
        numbers = torch.arange(first, first + num_envs) % episodes
        start = env.reset(starts[numbers % len(states)], set_state=True)
        acting = _replace_first_actions(policy, actions[numbers])
        parts.append(_summarize(*play_episodes(env, acting, start=start)))
    tasks = {
        name: _join(parts, range(index, episodes, len(states)))
        for index, name in enumerate(states)
    }
    return _join(parts, range(episodes), tasks)


def _replace_first_actions(policy: Policy, actions: Tensor) -> Policy:
    """Return a policy that takes the given actions first, and then its own.

    Args:
        policy: The policy.
        actions: The first actions, (num_envs, steps, action size).
    """
    remaining = list(actions.unbind(1))

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        if remaining:
            tensordict["action"] = remaining.pop(0)
        return tensordict

    return act


def _summarize(rollout: TensorDictBase, lengths: Tensor) -> Evaluation:
    """Return the results of episodes [num_envs, steps] with lengths (num_envs,)."""
    success = rollout["next", "success"].squeeze(-1)
    reward = rollout["next", "reward"].squeeze(-1)
    steps = torch.arange(rollout.shape[1], device=lengths.device)
    is_played = steps < lengths[:, None]
    return Evaluation(
        success=success.gather(1, lengths[:, None] - 1).squeeze(1),
        ever=(success & is_played).any(1),
        at_start=rollout["success"][:, 0, 0],
        returns=(reward * is_played).sum(1),
        lengths=lengths,
    )


def _join(
    parts: list[Evaluation],
    episodes: range,
    tasks: Mapping[str, Evaluation] | None = None,
) -> Evaluation:
    """Concatenate results, and select the episodes with these indices."""
    names = ("success", "ever", "at_start", "returns", "lengths")
    joined = {
        name: torch.cat([getattr(part, name) for part in parts]) for name in names
    }
    chosen = {name: x[list(episodes)].cpu() for name, x in joined.items()}
    return Evaluation(**chosen, tasks=tasks or {})


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """95 % confidence interval of a proportion after n trials (Wilson, 1927)."""
    z = 1.96  # the 97.5 % quantile of the normal distribution
    p = successes / n
    center = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, center - half), min(1.0, center + half)
