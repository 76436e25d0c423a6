"""Instructions a step of each layer, by valgrind: pytest -m slow -s <this file>.

Other work on the machine does not change them. A layer's share is what it takes beyond
the one before it; all take the same step of one environment, whose robot holds still.
"""

import gc
import os
import re
import shutil
import subprocess
import sys

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

import torch_panda

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
STEPS = 20
COUNTED = re.compile(r"^summary: (\d+)", re.MULTILINE)


class Empty(EnvBase):
    """An environment of the same specs that does nothing."""

    def __init__(self, env):
        super().__init__(batch_size=env.batch_size)
        for name in ("observation", "action", "reward", "done"):
            setattr(self, f"{name}_spec", getattr(env, f"{name}_spec").clone())
        self._start = env.reset()
        self._next = env.rollout(1)[:, 0]["next"]

    def _reset(self, tensordict=None, **kwargs):
        return self._start.copy()

    def _step(self, tensordict):
        return self._next.copy()

    def _set_seed(self, seed):
        pass


def make_layers(env):
    """By name, what takes so many steps."""
    episodes, action = env.episodes, torch.zeros(env.action_spec.shape)
    simulation = episodes.simulation
    policy = TensorDictModule(lambda _: action, ["observation"], ["action"])
    start = env.reset().set("action", action)

    def step_simulation(steps):
        setpoint = env.robot.setpoint(action, simulation).numpy()
        for _ in range(steps):
            simulation.step(env.robot.controller, setpoint)

    def step_episodes(steps):
        for _ in range(steps):
            episodes.step(action)

    def step_env(steps):
        for _ in range(steps):
            env.step(start.copy())

    def step_and_reset(env):
        def take(steps):
            td = env.reset()
            for _ in range(steps):
                _, td = env.step_and_maybe_reset(td.set("action", action))

        return take

    return {
        "simulation.step": step_simulation,
        "episodes.step": step_episodes,
        "step": step_env,
        "step_and_maybe_reset": step_and_reset(env),
        "rollout with a policy": lambda steps: env.rollout(steps, policy),
        "step_and_maybe_reset of an empty EnvBase": step_and_reset(Empty(env)),
    }


def count_layers():
    """Runs under callgrind, and lets it write a file for each count."""
    gc.disable()  # it would count for whoever comes next
    torch.set_num_threads(1)

    def control(*command):
        subprocess.run(["callgrind_control", *command, str(os.getpid())], check=True)

    with torch_panda.make("PandaPush-v1", num_envs=1, seed=0) as env:
        layers = make_layers(env)
        for take in layers.values():
            take(2)
        control("--instr=on")
        for take in layers.values():
            for steps in (STEPS, 2 * STEPS):
                env.reset()
                control("--zero")
                take(steps)
                control("--dump")
        print("\n".join(["layers", *layers]))


@pytest.mark.skipif(not shutil.which("valgrind"), reason="needs valgrind")
def test_python_between_two_steps_is_a_tenth_of_one(tmp_path):
    out = tmp_path / "counts"
    command = ["valgrind", "--tool=callgrind", "--instr-atstart=no"]
    command += [f"--callgrind-out-file={out}", sys.executable, __file__]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True
    )
    names = done.stdout.partition("layers\n")[2].splitlines()
    counts = []
    for index in range(1, 2 * len(names) + 1):
        found = COUNTED.search(out.with_name(f"counts.{index}").read_text())
        counts.append(int(found[1]))
    each = {
        name: (counts[2 * k + 1] - counts[2 * k]) / STEPS
        for k, name in enumerate(names)
    }
    print()
    for name, count in each.items():
        print(f"{name}: {count / 1e6:.2f} million instructions")
    assert each["step_and_maybe_reset"] < 1.1 * each["simulation.step"]


if __name__ == "__main__":
    count_layers()
