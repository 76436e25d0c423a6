"""Hyperparameters of the agents.

Numbers that no published command changes are constants where they are used.
"""

from dataclasses import dataclass
from typing import Literal

from torch_panda.learning.limits import Discount, Positive, Ratio, Weight

Algo = Literal["ddpg", "td3", "sac", "tqc"]
RelativeInputs = Literal["none", "coarse", "fine"]
Exploration = Literal["actions", "points"]
Network = Literal["paper", "layer-norm", "wide"]
AugmentationKind = Literal["none", "mirror", "mirror-shift"]


@dataclass
class Hyperparameters:
    """Hyperparameters, by default those of the panda-gym paper (arXiv 2106.13687)."""

    algo: Algo = "ddpg"
    """algorithm"""
    double_q: bool = True
    """learn two critics. Targets take the smaller value (TD3, SAC) or the lower
    quantiles of both (TQC). DDPG always has one critic"""
    gamma: Discount | None = None
    """discount factor; None means 1 - 1 / (steps of an episode), as in Baselines"""
    network: Network = "paper"
    """hidden layers of actors and critics: three of 256 units ("paper"), the same with
    LayerNorm ("layer-norm"), or three of 448 units with LayerNorm ("wide")"""
    target_interval: Positive = 1
    """gradient steps between two moves of the target networks"""
    action_l2: Weight = 1.0
    """DDPG, TD3: weight of the mean squared action in the actor's loss"""
    noise_eps: Weight = 0.2
    """DDPG, TD3: standard deviation of the Gaussian noise on actions"""
    random_eps: tuple[Ratio, Ratio] = (0.3, 0.3)
    """ratio of exploring steps in the first and in the last of the parallel
    environments; those between are evenly spaced. SAC and TQC need "points" for it"""
    exploration: Exploration = "actions"
    """explore with random actions (DDPG, TD3), or by moving towards random points
    ("points"; joint control moves to random joint positions)"""
    relative_inputs: RelativeInputs = "none"
    """further inputs of the networks: offsets of objects from the hand and of goals
    from objects ("coarse"); these and their values clipped at 3 cm, so that millimetres
    count ("fine")"""
    fine_fingers: bool = False
    """let networks and noise act on the cube root of the fingers' action, so that a
    tenth of a millimetre counts"""
    augmentation: AugmentationKind = "none"
    """mirror half of each batch in the robot's plane of symmetry ("mirror"), and also
    shift half of it over the table ("mirror-shift")"""
