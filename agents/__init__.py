"""Agents for the environments of `lag_envs`: learners, the optimum, and what all agents reach."""
