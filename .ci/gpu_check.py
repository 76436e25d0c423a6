"""Compares recorded gradient steps on a GPU with plain ones: their results and speed.

    python .ci/gpu_check.py

It runs in a few minutes, needs torch, tensordict and torchrl only, and makes its data
itself: episodes in which the hand and the cube of Push wander at random. Recorded and
plain steps start from the same weights and random numbers. After `COMPARED` steps, the
difference of their weights must be a small fraction of the weights; see `TOLERANCE`.

A second table compares `SEEDS` agents that take their steps together, as with ``train
--offline --seeds``, with the same agents one after another.

Without a GPU it takes a few plain steps with each algorithm, which measures nothing and
shows that the script works.
"""

import sys
import time
from collections.abc import Iterator
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import torch
import torchrl.collectors
import torchrl.objectives
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded


class Absent(Loader):
    """Stands in for modules that the package imports and this script does not use."""

    names = ("gymnasium", "tqdm", "tyro", "filelock", "imageio", "matplotlib")

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        """Find a module, after all other finders have failed."""
        is_absent = name.split(".")[0] in self.names
        return ModuleSpec(name, self, is_package=True) if is_absent else None

    def create_module(self, spec: ModuleSpec) -> MagicMock:
        """Make the module."""
        return MagicMock()

    def exec_module(self, module: MagicMock) -> None:
        """Leave the module as it is."""


# After torchrl, which looks for some of these modules too.
sys.meta_path.append(Absent())
sys.path.insert(0, str(Path(__file__).parents[1]))
sys.modules["torch_panda.bullet.library"] = MagicMock()

from torch_panda.learning.agents import Hyperparameters, find_agent  # noqa: E402
from torch_panda.learning.agents.base import Agent  # noqa: E402
from torch_panda.learning.agents.stacked import StackedAgents  # noqa: E402
from torch_panda.learning.environments.geometry import Geometry  # noqa: E402
from torch_panda.learning.environments.spaces import Spaces  # noqa: E402
from torch_panda.learning.offline_data import OfflineData  # noqa: E402
from torch_panda.learning.sources import DRAWN_AT_ONCE, draw_batches  # noqa: E402
from torch_panda.transforms import HindsightRelabel  # noqa: E402

HAS_GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda" if HAS_GPU else "cpu")
EPISODES, STEPS = 2_000 if HAS_GPU else 20, 50
BATCH_SIZE = 256
SEEDS = 8  # agents whose steps are taken together
COMPARED = 20 if HAS_GPU else 2  # steps whose results are compared
# Largest root mean square of the differences, as a fraction of that of the weights. A
# wrong batch or a missing update makes it 0.01 or more.
TOLERANCE = 1e-3
WARM_UP, TIMED = (200, 1_000) if HAS_GPU else (0, 2)  # steps before and in the timing
# The layout of Push. The hand's position is in the first three of the 18 observed
# numbers, and the cube's position follows the hand's velocity.
SIGNS = (1.0, -1.0, 1.0)
GEOMETRY = Geometry(
    points=(6, 7, 8, 18, 19, 20),
    origins=(0, 1, 2, 6, 7, 8),
    observation=SIGNS * 6,
    goal=SIGNS,
    action=SIGNS,
    positions=(0, 6),
    goal_positions=(0,),
    goal_height=None,
    orientation=None,
)
SPACES = Spaces(
    observation_size=18,
    goal_size=3,
    action_size=3,
    num_envs=8,
    max_episode_steps=STEPS,
    has_free_gripper=False,
    has_sparse_reward=True,
    geometry=GEOMETRY,
    action_scale=0.05,
    moves_joints=False,
)
OFFLINE = {"offline": True, "network": "gelu", "relative_inputs": "fine", "gamma": 0.99}
ONLINE = {
    **{"network": "layer-norm", "relative_inputs": "fine", "ema_rate": 0.003},
    **{"augmentation": "mirror-shift", "gamma": 0.95},
}
ALGORITHMS = {
    **{algo: OFFLINE for algo in ("gcivl", "gciql-nstep", "hiql", "qrl", "gcbc")},
    **{algo: ONLINE for algo in ("ddpg", "td3", "sac")},
}


def is_success(achieved_goal: torch.Tensor, desired_goal: torch.Tensor) -> torch.Tensor:
    """Whether the cube is within 5 cm of its goal, (..., 1)."""
    return (achieved_goal - desired_goal).norm(dim=-1, keepdim=True) < 0.05


ENV = SimpleNamespace(
    is_success=is_success,
    device=DEVICE,
    ndim=0,
    observation_spec=Composite(
        observation=Unbounded((SPACES.observation_size,)),
        achieved_goal=Unbounded((SPACES.goal_size,)),
        desired_goal=Unbounded((SPACES.goal_size,)),
    ),
)


def reward(achieved_goal: torch.Tensor, desired_goal: torch.Tensor) -> torch.Tensor:
    """0 at the goal and -1 elsewhere, (..., 1)."""
    return is_success(achieved_goal, desired_goal).float() - 1.0


def make_data() -> TensorDict:
    """Transitions of whole episodes, (EPISODES * STEPS,)."""
    shape = EPISODES, STEPS
    states = 0.02 * torch.randn(EPISODES, STEPS + 1, SPACES.observation_size)
    states = states.cumsum(1)
    goal = 0.1 * torch.randn(EPISODES, 1, 3).expand(*shape, 3)
    achieved = states[..., 6:9]
    done = torch.zeros(*shape, 1, dtype=torch.bool)
    done[:, -1] = True
    after = {
        "observation": states[:, 1:],
        "achieved_goal": achieved[:, 1:],
        "desired_goal": goal,
        "reward": reward(achieved[:, 1:], goal),
        "terminated": torch.zeros_like(done),
        "done": done,
    }
    data = {
        "observation": states[:, :-1],
        "desired_goal": goal,
        "action": 2 * torch.rand(*shape, 3) - 1,
        "collector": {"traj_ids": torch.arange(EPISODES)[:, None].expand(shape)},
        "next": after,
    }
    return TensorDict(data, shape).reshape(-1).to(DEVICE)


class Training:
    """An agent and its data, which take gradient steps as `train` does."""

    def __init__(self, algo: str, data: TensorDict, seed: int = 0) -> None:
        torch.manual_seed(seed)
        hp = Hyperparameters(algo=algo, **ALGORITHMS[algo])
        with torch.device(DEVICE):
            self.agent = find_agent(hp)(SPACES, hp)
        self.agent.normalizer.update(data["observation"], data["desired_goal"])
        if hp.offline:
            rows = OfflineData(data, ENV, self.agent.goal_strategies, self.agent.gamma)
            self.draw = lambda size: self.agent.extend(rows.sample(size), rows)
        else:
            buffer = torchrl.data.TensorDictReplayBuffer(
                storage=torchrl.data.LazyTensorStorage(len(data), device=DEVICE),
                transform=HindsightRelabel(reward),
            )
            buffer.extend(data)
            self.draw = buffer.sample

    def batches(self, number: int, *, at_once: bool) -> Iterator[TensorDict]:
        """Draw batches, many at once or one by one."""
        device = DEVICE if at_once else torch.device("cpu")
        return draw_batches(self.draw, BATCH_SIZE, number, device)

    def take_steps(self, number: int, *, at_once: bool) -> None:
        """Take gradient steps, on batches drawn at once or one by one."""
        for batch in self.batches(number, at_once=at_once):
            self.agent.update(batch)
        synchronize()

    def measure(self, *, at_once: bool) -> float:
        """Gradient steps per second."""
        self.take_steps(WARM_UP, at_once=at_once)
        start = time.perf_counter()
        self.take_steps(TIMED, at_once=at_once)
        return TIMED / (time.perf_counter() - start)


def synchronize() -> None:
    """Wait for the GPU."""
    if HAS_GPU:
        torch.cuda.synchronize()


def weights(agent: Agent) -> torch.Tensor:
    """All weights of an agent in one vector."""
    parameters = [x.flatten() for x in agent.parameters()]
    return torch.cat(parameters).detach().double()


def difference(one: torch.Tensor, other: torch.Tensor) -> float:
    """Root mean square of the difference, as a fraction of that of the weights."""
    return float((one - other).norm() / one.norm())


def compare_recorded(algo: str, data: TensorDict) -> tuple[float, float, float]:
    """Plain and recorded steps per second, and the difference of their weights."""
    results, speeds = [], []
    for records in (False, True):
        Agent.records_steps = records and HAS_GPU
        training = Training(algo, data)
        training.take_steps(COMPARED, at_once=True)
        results.append(weights(training.agent))
        # Plain steps draw their batches one by one, as before they were recorded.
        speeds.append(training.measure(at_once=records))
    return *speeds, difference(*results)


def compare_seeds(algo: str, data: TensorDict) -> tuple[float, float, float]:
    """Steps per second of one agent and of `SEEDS`, and the difference of weights."""
    Agent.records_steps = HAS_GPU
    alone, group = ([Training(algo, data, i) for i in range(SEEDS)] for _ in range(2))
    agents = StackedAgents([training.agent for training in group])

    def take_together(number: int) -> list[tuple[TensorDict, ...]]:
        drawn = [training.batches(number, at_once=True) for training in group]
        rows = [*zip(*drawn, strict=True)]
        for batches in rows:
            agents.update(batches)
        synchronize()
        return rows

    rows = take_together(COMPARED)
    agents.write_back()
    differences = []
    for i, training in enumerate(alone):
        for batches in rows:
            training.agent.update(batches[i])
        other = weights(group[i].agent)
        differences.append(difference(weights(training.agent), other))
    take_together(WARM_UP)
    start = time.perf_counter()
    for _ in range(0, TIMED, DRAWN_AT_ONCE):
        take_together(min(DRAWN_AT_ONCE, TIMED))
    speed = SEEDS * TIMED / (time.perf_counter() - start)
    return alone[0].measure(at_once=True), speed, max(differences)


def main() -> None:
    """Check every algorithm, and print a row of a table for it."""
    device = torch.cuda.get_device_name() if HAS_GPU else "no GPU, nothing is measured:"
    print(device, "torch", torch.__version__, flush=True)
    data, failed = make_data(), []
    offline = [algo for algo, options in ALGORITHMS.items() if options is OFFLINE]
    for compare, names, algorithms in (
        (compare_recorded, ("plain", "recorded"), ALGORITHMS),
        (compare_seeds, ("one agent", f"{SEEDS} agents"), offline),
    ):
        units = " | ".join(f"{name} [steps/s]" for name in names)
        print(f"| algorithm | {units} | ratio | difference |\n|---|---|---|---|---|")
        for algo in algorithms:
            before, after, change = compare(algo, data)
            row = f"{before:.0f} | {after:.0f} | {after / before:.1f} | {change:.1e}"
            print(f"| {algo} | {row} |", flush=True)
            if not change < TOLERANCE:
                failed.append(algo)
    if failed:
        raise SystemExit(f"the weights differ: {', '.join(failed)}")


if __name__ == "__main__":
    main()
