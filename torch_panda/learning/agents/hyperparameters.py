"""Hyperparameters of the agents, which are also options of the commands.

Numbers that nobody needs to change are constants in the files that use them.
"""

from dataclasses import dataclass
from typing import Literal

from torch_panda.learning.limits import Discount, Ratio, Weight

OnlineAlgo = Literal["ddpg", "td3", "sac", "crl"]
OfflineAlgo = Literal["gcbc", "gcivl", "gciql", "gciql-nstep", "hiql", "qrl", "crl"]
Algo = Literal[OnlineAlgo, OfflineAlgo]
ActorGoal = Literal["future", "geometric"]
RelativeInputs = Literal["none", "coarse", "fine"]
Exploration = Literal["actions", "points"]
Network = Literal["paper", "layer-norm", "wide", "gelu"]
AugmentationKind = Literal["none", "mirror", "mirror-shift"]
Critics = Literal["whole", "parts"]


@dataclass
class Hyperparameters:
    """Hyperparameters, by default those of the panda-gym paper (arXiv 2106.13687)."""

    algo: Algo = "ddpg"
    """algorithm: DDPG, TD3, SAC or CRL; with --offline GCBC, GCIVL, GCIQL, GCIQL with
    n-step returns, HIQL, QRL or CRL"""
    offline: bool = False
    """learn from a data set instead of an environment"""
    double_q: bool = True
    """TD3, SAC: learn two critics, and use the smaller value as target"""
    critics: Critics = "whole"
    """DDPG: what the critic learns from. "whole" learns one critic from the rewards of
    the task. "parts" learns a critic for each object's part of the goal, from rewards
    for this part alone, and the policy maximises their mean. The numbers of the other
    objects are a tenth as large in its inputs, so that it soon ignores them"""
    gamma: Discount | None = None
    """discount factor; None means 1 - 1 / (steps of an episode), as in OpenAI
    Baselines"""
    network: Network = "paper"
    """hidden layers of actors and critics: three of 256 units ("paper"), the same with
    LayerNorm ("layer-norm"), three of 448 units with LayerNorm ("wide"), or three of
    256 units with LayerNorm and GELU instead of ReLU ("gelu")"""
    action_l2: Weight = 1.0
    """DDPG, TD3, CRL: weight of the mean squared action in the actor's loss"""
    ema_rate: Ratio = 0.0
    """rate of an exponential moving average (EMA) of the actor's weights. In each
    gradient step the average moves this fraction of the way to the actor. The average
    is evaluated and saved as the policy, and the actor itself explores. 0 evaluates
    and saves the actor"""
    noise_eps: Weight = 0.2
    """DDPG, TD3, CRL: standard deviation of the Gaussian noise on actions"""
    random_eps: tuple[Ratio, Ratio] = (0.3, 0.3)
    """fraction of exploring steps in the first and in the last of the parallel
    environments. The fractions of the other environments are evenly spaced between
    them. SAC uses this option only with exploration "points" """
    exploration: Exploration = "actions"
    """how to explore. "actions" takes random actions with DDPG, TD3 and CRL. With SAC
    it has no effect, because its policy is random. "points" moves the hand towards
    random points, or under joint control the joints towards random positions"""
    relative_inputs: RelativeInputs = "none"
    """additional inputs of the networks. "coarse" adds the offsets from the hand to
    objects and from objects to goals. "fine" also adds these offsets clipped at 3 cm,
    so that differences of millimetres count"""
    fine_fingers: bool = False
    """let networks and noise work with the cube root of the fingers' action, so that a
    difference of 0.1 mm is larger than the error of a network"""
    augmentation: AugmentationKind = "none"
    """mirror half of each batch in the robot's plane of symmetry ("mirror"), and also
    shift half of each batch over the table ("mirror-shift")"""
    actor_goal: ActorGoal = "future"
    """with --offline, how to draw the goals of the policy among those achieved later in
    the episode. "future", as in OGBench: all are equally likely. "geometric": the goal
    achieved k steps later has probability proportional to gamma**k"""
    alpha: Weight | None = None
    """with --offline, weight of the imitation in the policy's loss (GCIQL, CRL), or
    inverse temperature of the weights of imitated actions (GCIVL, HIQL, QRL). None
    means the default of the algorithm. GCBC has none"""
