"""panda-gym's Push, of the release that is installed, for the timings beside it."""

import gymnasium
import panda_gym

PUSH = f"PandaPush-v{panda_gym.__version__[0]}"


def make_push():
    return gymnasium.make(PUSH)
