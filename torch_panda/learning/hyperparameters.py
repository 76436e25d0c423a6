"""The agents' options; what no published command changes is a constant in its place."""

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
    """Of the agents. The defaults are the panda-gym paper's (arXiv 2106.13687)."""

    algo: Algo = "ddpg"
    """the algorithm"""
    double_q: bool = True
    """learn two critics and take the smaller of their values for targets (TD3, SAC), or
    the lower part of both (TQC); DDPG has one critic in any case"""
    gamma: Discount | None = None
    """the discount factor; None means 1 - 1 / (steps of an episode), as in Baselines"""
    network: Network = "paper"
    """the hidden layers of actors and critics: three of 256 units ("paper"), each of
    them normalised by LayerNorm ("layer-norm"), or three of 448 such units ("wide")"""
    target_interval: Positive = 1
    """gradient steps between two moves of the target networks"""
    action_l2: Weight = 1.0
    """DDPG, TD3: the weight of the mean squared action in the actor's loss"""
    noise_eps: Weight = 0.2
    """DDPG, TD3: the standard deviation of the Gaussian noise on actions"""
    random_eps: tuple[Ratio, Ratio] = (0.3, 0.3)
    """ratio of exploring steps in the first and in the last of the parallel
    environments; those between are evenly spaced. SAC and TQC need "points" for it"""
    exploration: Exploration = "actions"
    """explore with random actions (DDPG, TD3), or by moving towards random points
    ("points"; joint control moves to random joint positions)"""
    relative_inputs: RelativeInputs = "none"
    """give the networks positions of objects from the hand and of goals from objects,
    too ("coarse"), and these once more clipped, so that millimetres count ("fine")"""
    fine_fingers: bool = False
    """let networks and noise choose the cube root of what the fingers are told, so that
    a tenth of a millimetre counts"""
    augmentation: AugmentationKind = "none"
    """mirror half of each batch in the robot's plane of symmetry, and, if wanted, shift
    the scene over the table in half of it"""
