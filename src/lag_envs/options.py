"""The options of modules that are run."""

from __future__ import annotations

import argparse
from typing import Any


def module_parser(module: str, about: str | None, examples: str, **options: Any) -> argparse.ArgumentParser:
    """Return the parser of ``python -m MODULE``, whose help keeps the line breaks of its texts."""
    return argparse.ArgumentParser(
        prog=f"python -m {module}",
        description=about,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **options,
    )
