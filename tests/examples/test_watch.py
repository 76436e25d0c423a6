"""The examples that draw: a video of a policy, and the picture of all tasks."""

import imageio.v3 as iio
import numpy as np
import pytest

import gallery
import watch


@pytest.mark.parametrize("policy", ["random", "expert"])
def test_video_shows_every_step(tmp_path, policy):
    out = tmp_path / "watch.gif"
    watch.main(watch.Args(policy=policy, env_id="PandaReach-v1", num_envs=2, out=out))
    frames = iio.imread(out)
    assert frames.shape == (51, 240, 640, 3)
    moved = np.abs(np.diff(frames.astype(int), axis=0)).max((1, 2, 3))
    assert (moved[:10] > 100).all()
    # The border of a solved cell is green.
    borders = frames[-1, 120, [1, 321]].astype(int)
    solved = borders[:, 1] > borders[:, 0] + 50
    assert solved.all() == (policy == "expert")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "nothing"}, "random, expert or a run, got 'nothing'"),
        ({"env_id": "PandaFly-v1"}, "unknown environment id 'PandaFly-v1'"),
        ({"out": "watch.txt"}, "must end in .mp4 or .gif, got 'watch.txt'"),
        ({"env_id": "PandaPushJoints-v1"}, "no expert for 'PandaPushJoints-v1'"),
    ],
)
def test_bad_input_is_one_line(tmp_path, arguments, message):
    if "out" in arguments:
        arguments["out"] = tmp_path / arguments["out"]
    with pytest.raises(SystemExit, match=message):
        watch.main(watch.Args(**arguments))


def test_gallery(tmp_path):
    gallery.main(gallery.Args(step=1, size=(60, 80), out=tmp_path / "gallery.png"))
    picture = iio.imread(tmp_path / "gallery.png")
    assert picture.shape == (120, 240, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
