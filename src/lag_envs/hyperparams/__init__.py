"""Hyperparameters of Stable-Baselines3's learners, one YAML file for each, in the form of the RL Zoo."""

from pathlib import Path

#: The folder of the files.
HYPERPARAMS = Path(__file__).parent


def learners() -> list[str]:
    """Return the names of the learners."""
    return sorted(file.stem for file in HYPERPARAMS.glob("*.yml"))
