"""``python -m torch_panda``; see `torch_panda.commands`."""

from torch_panda.commands import main

if __name__ == "__main__":
    main()
