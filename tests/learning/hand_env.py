"""A goal environment of Gymnasium in NumPy: a hand that drags an object along."""

import itertools
from typing import ClassVar, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

MAX_STEPS = 20
NEAR = 0.5  # a goal that is nearer than this is reached
SPEED = 0.05  # displacement per step of the hand, if an action of 1 goes on

# They are not symmetric, and their differences in float32 are rounded.
LOW = np.array([-2.0, 0.1, -0.3, -0.5], dtype=np.float32)
HIGH = np.array([0.7, 4.0, 1.1, 0.5], dtype=np.float32)

_numbers = itertools.count()


class HandEnv(gymnasium.Env):
    """A hand that follows the first three actions with a lag, and an object.

    Args:
        parts: Parts of the observation, in this order.
        rewards: "sparse" are -1 and 0, "binary" 0 and 1, "dense" minus the distance.
        goals: Goals that `compute_reward` takes; given several, it raises
            ("raises") or returns one number ("norm") or one number for
            each coordinate ("indices").
        tells: Entries of ``info`` that say whether the time is odd or even, or that
            exist only where the x of the hand is positive.
        ends: Ends an episode at success, or at failure, once the time is 5.
        follows: Whether the hand follows the actions.
        goal_size: Number of coordinates of a goal.
        num_actions: Size of an action. Its first three numbers move the hand.
        has_object: Whether the goal is the object's and not the hand's.
        is_broken: Whether rendering fails.
        render_mode: As in Gymnasium.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(
        self,
        parts=("time", "velocity", "object", "hand", "action"),
        rewards: Literal["sparse", "binary", "dense"] = "sparse",
        goals="several",
        tells=(),
        ends: Literal["never", "success", "failure"] = "never",
        follows=True,
        goal_size=3,
        num_actions=4,
        has_object=True,
        is_broken=False,
        render_mode=None,
    ):
        self.parts, self.rewards, self.goals, self.tells = parts, rewards, goals, tells
        self.ends, self.follows, self.has_object = ends, follows, has_object
        self.goal_size = goal_size
        self.is_broken, self.render_mode = is_broken, render_mode
        self.num_actions = num_actions
        self.low, self.high = (np.resize(x, num_actions) for x in (LOW, HIGH))
        self.action_space = Box(self.low, self.high)
        self._start()
        spaces = {
            key: Box(-np.inf, np.inf, x.shape, dtype=float)
            for key, x in self._observe().items()
        }
        self.observation_space = Dict(spaces)

    def _start(self):
        draw = self.np_random.uniform
        self.time = np.zeros(1)
        self.hand, self.velocity = draw(-0.3, 0.3, 3), np.zeros(3)
        self.object = self.hand + draw(0.1, 0.2, 3)
        self.goal, self.action = draw(-0.6, 0.6, 3), np.zeros(self.num_actions)

    def _observe(self):
        achieved = self.object if self.has_object else self.hand
        observation = np.concatenate([getattr(self, part) for part in self.parts])
        return {
            "observation": observation,
            "achieved_goal": achieved[: self.goal_size].copy(),
            "desired_goal": self.goal[: self.goal_size].copy(),
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._start()
        return self._observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.time = self.time + 1
        self.action = action.astype(float)
        centre, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        move = ((action - centre) / half)[:3]
        if not self.follows:
            move = self.np_random.uniform(-1, 1, 3)
        self.velocity = 0.5 * self.velocity + 0.5 * SPEED * move
        self.hand = self.hand + self.velocity
        self.object[0] += 0.5 * self.velocity[0]  # on a rail along x
        observation = self._observe()
        achieved = observation["achieved_goal"]
        info = {
            key: self._tell(says) for key, says in self.tells if self._does_tell(says)
        }
        is_late = self.time[0] == 5
        is_end = bool(is_late and self.ends != "never")
        if self.ends == "success":
            info["is_success"] = is_end
        reward = float(self.compute_reward(achieved, observation["desired_goal"], info))
        return observation, reward, is_end, False, info

    def _does_tell(self, says):
        return says != "only where x > 0" or self.hand[0] > 0

    def _tell(self, says):
        is_odd = self.time[0] % 2 == 1
        flag = {"odd": is_odd, "even": not is_odd, "only where x > 0": True}[says]
        return np.float32(flag)  # as in Fetch

    def compute_reward(self, achieved_goal, desired_goal, info):
        difference = achieved_goal - desired_goal
        distance = np.linalg.norm(difference, axis=-1)
        if self.goals == "raises" and distance > 1e9:  # no bool of an array
            raise AssertionError
        if self.goals == "norm":
            distance = np.linalg.norm(difference)
        if self.goals == "indices":
            distance = np.sqrt(sum(difference[k] ** 2 for k in range(self.goal_size)))
        return {
            "sparse": -(distance > NEAR).astype(np.float32),
            "binary": (distance <= NEAR).astype(np.float32),
            "dense": -distance,
        }[self.rewards]

    def render(self):
        if self.is_broken:
            raise RuntimeError("no display")
        picture = np.zeros((40, 60, 3), dtype=np.uint8)
        picture[:, 30:] = 255
        return picture


def register(cls=HandEnv, max_episode_steps=MAX_STEPS, **options):
    """Register an environment with Gymnasium under an id of its own."""
    env_id = f"Hand{next(_numbers)}-v0"
    gymnasium.register(env_id, cls, max_episode_steps=max_episode_steps, kwargs=options)
    return env_id
