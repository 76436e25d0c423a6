"""Losses that several of the agents for data sets share.

The docstrings of the losses cite the papers. In the papers a goal is a state g. Here a
goal is the part of a state that the task cares about, such as the position of a cube,
because the policy gets ``desired_goal``.
"""

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

MAX_WEIGHT = 100.0  # largest weight of a row in advantage-weighted regression
# OGBench's learning rate of Adam, and its weight of the trained networks when target
# networks are updated (not the tau of expectiles). OGBench has 512 units and batches of
# 1,024. Here both are 256, so that a gradient step takes an eighth of the time, which
# suits a CPU.
OGBENCH_RATES = (3e-4, 0.005)


def make_mean_policy(actor: nn.Module) -> TensorDictModule:
    """Make the policy of an actor that outputs a mean action, clipped to [-1, 1]."""
    clipped = nn.Sequential(actor, nn.Hardtanh())
    return TensorDictModule(clipped, ["normalized"], ["action"])


def log_prob(mean: Tensor, x: Tensor) -> Tensor:
    """Log density of a Gaussian with unit variance, without its constant, (n,)."""
    return -0.5 * (x - mean).square().sum(-1)


def expectile_loss(diff: Tensor, advantage: Tensor, expectile: float) -> Tensor:
    """Squared differences, weighted by the sign of the advantage (2110.06169, eq. 5).

    In the paper the advantage is the difference itself.

    Args:
        diff: Target minus prediction, (..., n).
        advantage: Advantage of each row, (n,).
        expectile: Weight of rows whose advantage is at least 0, tau in the paper.
            Others have the weight 1 - tau.

    Returns:
        The weighted squares, (..., n).
    """
    weight = torch.where(advantage < 0, 1 - expectile, expectile)
    return weight * diff.square()


def ensemble_loss(q: Tensor, v: Tensor, v_target: Tensor, expectile: float) -> Tensor:
    """Expectile regression of the two values of an `Ensemble`, a scalar.

    HIQL's paper (2307.11949, eq. 4) has one value function. Here there are two, as in
    OGBench, and each regresses to its own target. Both squared errors have the same
    weight, which depends on the advantage: the smaller target minus the mean of the two
    ``v_target``.

    Args:
        q: Targets r + discount * mask * V(s', g) of the target networks, (2, n).
        v: Values V(s, g), (2, n).
        v_target: Values V(s, g) of the target networks, (2, n).
        expectile: See `expectile_loss`.
    """
    advantage = q.amin(0) - v_target.mean(0)
    return expectile_loss(q - v, advantage, expectile).sum(0).mean()


def weighted_regression(log_probs: Tensor, advantage: Tensor, alpha: float) -> Tensor:
    """Advantage-weighted regression, a scalar (2110.06169, eq. 7).

    The paper writes beta for ``alpha``.

    Args:
        log_probs: Log probabilities of the imitated actions or waypoints, (n,).
        advantage: Their advantages, (n,).
        alpha: Inverse temperature. 0 imitates all rows alike.
    """
    weight = (alpha * advantage.detach()).exp().clamp(max=MAX_WEIGHT)
    return -(weight * log_probs).mean()


def ascend_and_imitate(q: Tensor, log_probs: Tensor, alpha: float) -> Tensor:
    """DDPG+BC, as in OGBench: ascend Q, and imitate the data with weight alpha.

    TD3+BC (2106.06860) has the same two terms, but its alpha is the weight of Q.

    Args:
        q: Values of the policy's actions, (n,). They are divided by their mean
            magnitude, so that alpha does not depend on the scale of rewards.
        log_probs: Log probabilities of the actions of the data, (n,).
        alpha: Weight of the imitation.
    """
    scale = q.detach().abs().mean() + 1e-6
    return -q.mean() / scale - alpha * log_probs.mean()
