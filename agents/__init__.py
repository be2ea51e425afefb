"""Agents for the environments of `lag_envs`: classical controllers and learners."""
