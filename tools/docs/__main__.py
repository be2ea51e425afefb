"""Write the texts generated from the environments' records into README and docs: ``python -m tools.docs``.

``python -m tools.docs --pictures`` also draws the environments' moving pictures, from episodes of the
leaderboard's best learned agents; with ids, only for the given environments.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lag_envs.errors import hint
from lag_envs.generated import replaced
from lag_envs.options import module_parser
from lag_envs.store import write_file
from lag_envs.tasks import TASKS
from tools.docs.environments import ROOT, by_scene


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the generated texts of this checkout."""
    parser = module_parser(
        "tools.docs",
        "Write the texts generated from records.",
        "examples:\n  python -m tools.docs\n  python -m tools.docs --pictures PivotedBar-v0",
    )
    parser.add_argument(
        "--pictures", nargs="*", metavar="ID", help="draw moving pictures too, by default of all environments"
    )
    args = parser.parse_args(arguments)
    for env_id in args.pictures or ():
        if env_id not in TASKS:
            parser.error(f"there is no environment {env_id!r}; {hint(env_id, TASKS)}")
    for path, text in generated(ROOT).items():
        write_file(path, text)
    if args.pictures is not None:
        from tools.docs.pictures import draw_environments

        draw_environments(ROOT / "leaderboard", ROOT / "docs" / "images" / "moving", args.pictures or TASKS)
    return 0


def generated(root: Path) -> dict[Path, str]:
    """Return what the generated files should contain."""
    readme = root / "README.md"
    text = replaced(readme.read_text(encoding="utf-8"), "environments", by_scene(source))
    return {readme: text}


def source(env_id: str) -> str:
    """Return the path of an environment's record, for those who read README without the site."""
    return f"src/{TASKS[env_id].__module__.replace('.', '/')}.py"


if __name__ == "__main__":
    sys.exit(main())
