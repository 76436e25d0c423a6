"""Imitation of demonstrations in the actor's loss (Nair et al., arXiv 1709.10089)."""

from torch import Tensor

BC_WEIGHT = 20.0  # of imitation in the actor's loss


def imitation_loss(
    action: Tensor, demonstrated: Tensor, value: Tensor, demonstrated_value: Tensor
) -> Tensor:
    """Mean squared difference to the demonstrated actions that the critic prefers.

    Args:
        action: of the policy, (n, action size).
        demonstrated: in the same states, (n, action size).
        value: that the critic gives the policy's actions, (n, 1).
        demonstrated_value: that it gives the demonstrated ones, (n, 1).
    """
    preferred = (demonstrated_value > value).detach()  # the Q filter
    return BC_WEIGHT * ((action - demonstrated).square() * preferred).mean()
