"""Records the episodes of panda-gym 1.1.0 that the tests compare -v1 with.

    pip download --no-deps panda-gym==1.1.0
    unzip panda_gym-1.1.0-py3-none-any.whl -d FOLDER
    python tests/envs/record_panda_gym_1_1_0.py FOLDER

It writes panda_gym_1_1_0.npz beside this file. That release needs the old `gym` for its
spaces, its seeding and its registration only; a stub of these few names serves.
"""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

FILE = Path(__file__).with_name("panda_gym_1_1_0.npz")
TASKS = ("Reach", "Push", "Slide", "PickAndPlace", "Stack")
EPISODES = 6
STEPS = 60
LIFTED = 0.06  # [m]; a cube's centre is only this high if the fingers hold the cube


class _Box:
    def __init__(self, low, high, shape):
        self.low, self.high = (np.full(shape, x, np.float32) for x in (low, high))


def stub_gym():
    """The part of gym that panda-gym 1.1.0 imports."""

    def module(name, **content):
        sys.modules[name] = ModuleType(name)
        vars(sys.modules[name]).update(content)
        return sys.modules[name]

    def np_random(seed):
        return np.random.default_rng(seed), seed

    utils = SimpleNamespace(seeding=SimpleNamespace(np_random=np_random))
    spaces = module("gym.spaces", Box=_Box, Dict=dict)
    module("gym", GoalEnv=object, utils=utils, spaces=spaces)
    module("gym.envs")
    module("gym.envs.registration", register=lambda **ignored: None)


def choose_action(task, observation, item, rng):
    """Move to object number `item`, go down, and with a gripper carry it away.

    Noisy, and often out of range.
    """
    has_gripper = task in ("PickAndPlace", "Stack")
    noise = rng.normal(size=4 if has_gripper else 3)
    if task == "Reach":
        return noise * 1.5
    if not has_gripper:
        towards = (observation[6:9] - observation[:3]) * 30
        return towards + noise * 0.3 if rng.random() < 0.9 else noise * 1.5
    ee, width = observation[:3], observation[6]
    offset = observation[7 + 12 * item :][:3] - ee
    near = np.abs(offset).max() < 0.015
    if near and width < 0.045:
        # The object is grasped: carry it around and sometimes let go.
        grip = 1.0 if rng.random() < 0.05 else -1.0
        return np.append(noise[:3] * 0.5 + (0.0, 0.0, 0.5), grip)
    over = np.linalg.norm(offset[:2]) > 0.012
    aim = offset + np.array((0.0, 0.0, 0.06 * over))
    return np.append(aim * 16 + noise[:3] * 0.02, -1.0 if near else 0.5)


def record(task, make, seed):
    """One episode of a new environment, as arrays."""
    env = make()
    env.seed(seed)
    observed = env.reset()
    sim, rng = env.sim, np.random.default_rng(seed)
    names = [n for n in ("object", "object1", "object2") if n in sim._bodies_idx]
    robot = sim._bodies_idx["panda"]
    poses = [(*sim.get_base_position(n), *sim.get_base_orientation(n)) for n in names]
    episode = {
        "object_pose": np.reshape(poses, (len(names), 7)),
        "goal": env.task.get_goal(),
    }
    rows = {key: [] for key in ("action", "success", "reward", "touched", "grasped")}
    observations = [observed]
    for _ in range(STEPS):
        item = seed % len(names) if names else 0
        action = choose_action(task, observed["observation"], item, rng)
        action = action.astype(np.float32)
        observed, reward, _, info = env.step(action)
        touched = [
            n
            for n in (*names, "table")
            if sim.physics_client.getContactPoints(robot, sim._bodies_idx[n])
        ]
        fingers = [
            {c[3] for c in sim.physics_client.getContactPoints(robot, body)}
            for body in (sim._bodies_idx[n] for n in names)
        ]
        heights = [sim.get_base_position(n)[2] for n in names]
        grasped = any(
            {9, 10} <= links and height > LIFTED
            for links, height in zip(fingers, heights, strict=True)
        )
        rows["action"].append(action)
        observations.append(observed)
        rows["reward"].append(reward)
        rows["success"].append(info["is_success"])
        rows["touched"].append(bool(touched))
        rows["grasped"].append(grasped)
    env.sim.physics_client.disconnect()
    episode["start"] = observations[0]["observation"].astype(np.float32)
    for key in ("observation", "achieved_goal"):
        rows[key] = np.stack([o[key] for o in observations[1:]]).astype(np.float32)
    return episode | {key: np.asarray(values) for key, values in rows.items()}


def main(folder):
    """Record all tasks and write the file."""
    stub_gym()
    sys.path.insert(0, folder)
    import panda_gym.envs as envs

    arrays = {}
    for task in TASKS:
        make = getattr(envs, f"Panda{task}Env")
        episodes = [record(task, make, seed) for seed in range(EPISODES)]
        for key in episodes[0]:
            arrays[f"{task}/{key}"] = np.stack([episode[key] for episode in episodes])
        touched, grasped = (
            arrays[f"{task}/{key}"].sum(1).tolist() for key in ("touched", "grasped")
        )
        print(f"{task}: steps in contact {touched}, with a cube in the air {grasped}")
    np.savez_compressed(FILE, **arrays)
    print(f"{FILE.stat().st_size / 1e3:.0f} kB in {FILE}")


if __name__ == "__main__":
    main(sys.argv[1])
