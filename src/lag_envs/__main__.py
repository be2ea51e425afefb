"""``python -m lag_envs`` is ``lag-envs``."""

import sys

from lag_envs.cli import main

if __name__ == "__main__":
    sys.exit(main())
