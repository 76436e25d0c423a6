"""``python -m torch_panda bench``: steps per second beside those of others."""
